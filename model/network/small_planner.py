"""Small planners without pictures: the blind one and the privileged one, which keep tables honest.

The blind planner sees history and route alone: who claims to see must beat it. The teacher sees the tracks
of everybody around as well: it tells what seeing is worth. Both plan in microseconds and train in minutes.
A third kind is given facts, true ones or those that were read from pictures: it tells what perception is
worth to a plan, and drives nowhere.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from model.driving.facts import FACTS
from model.driving.scene import Scene, SceneError
from model.driving.tracks import MAX_TRACKS
from model.driving.trajectory import (
    FUTURE_STEPS,
    HISTORY_STEPS,
    ROUTE_POINTS,
    ROUTE_SPACING_M,
    STEP_S,
    FloatArray,
)
from model.network.codec import CodecError, TrajectoryCodec
from model.network.track_features import TRACK_FEATURES, track_features
from model.network.trajectory_head import Guesses, TrajectoryHead

SmallKind = Literal["blind", "teacher", "facts"]
DRIVING_KINDS: Final[tuple[SmallKind, ...]] = ("blind", "teacher")
WEIGHTS_FILE: Final = "planner.safetensors"
_VERSION: Final = 1
_TRACK_WIDTH: Final = 96
_WIDTH: Final = 256
_POSE_SCALE: Final = (10.0, 2.0, 0.3)
_OUTLIER: Final = 6.0


class SmallPlannerError(ValueError):
    """A folder that holds no small planner, or one of another version; the text says which."""


@dataclass(frozen=True)
class SmallInputs:
    """A batch of what small planners see.

    Attributes:
        history: float32 [b, 16, 4].
        route: float32 [b, 20, 2].
        tracks: float32 [b, 16, features]; nobody anywhere where they are not known.
        facts: float32 [b, len(FACTS)], or None.
    """

    history: Tensor
    route: Tensor
    tracks: Tensor
    facts: Tensor | None = None

    def __getitem__(self, rows: Tensor | slice) -> SmallInputs:
        facts = None if self.facts is None else self.facts[rows]
        return SmallInputs(self.history[rows], self.route[rows], self.tracks[rows], facts)

    @property
    def speeds_ms(self) -> Tensor:
        """Present speeds [b]."""
        return -self.history[:, -4, 0] / (3 * STEP_S)


class SmallPlanner(nn.Module):
    """A multilayer perceptron over history and route and, for the teacher, a pooled set of tracks.

    Args:
        kind: the blind one ignores tracks and facts.
        codec: whose space it plans in.
        dropout: in training.
    """

    def __init__(self, kind: SmallKind, codec: TrajectoryCodec, dropout: float = 0.2) -> None:
        super().__init__()
        self.kind, self.codec = kind, codec
        inputs = 3 * (2 * HISTORY_STEPS - 1) + 2 * 2 * ROUTE_POINTS
        self.tracks: nn.Sequential | None = None
        if kind == "teacher":
            self.tracks = nn.Sequential(
                nn.Linear(len(TRACK_FEATURES) + 1, _TRACK_WIDTH),
                nn.SiLU(),
                nn.Linear(_TRACK_WIDTH, _TRACK_WIDTH),
                nn.SiLU(),
                nn.Linear(_TRACK_WIDTH, _TRACK_WIDTH),
            )
            inputs += 2 * _TRACK_WIDTH
        if kind == "facts":
            inputs += len(FACTS)
        layers: list[nn.Module] = []
        for width in (inputs, _WIDTH, _WIDTH):
            layers += [nn.Linear(width, _WIDTH), nn.LayerNorm(_WIDTH), nn.SiLU(), nn.Dropout(dropout)]
        self.trunk = nn.Sequential(*layers[:-1])
        self.head = TrajectoryHead(_WIDTH, codec)

    def forward(self, inputs: SmallInputs) -> Guesses:
        """Guesses for a batch."""
        poses = inputs.history[..., [0, 1, 3]]
        scale = poses.new_tensor(_POSE_SCALE)
        straight = ROUTE_SPACING_M * torch.arange(1, ROUTE_POINTS + 1, device=poses.device)
        aside = inputs.route - torch.stack([straight, torch.zeros_like(straight)], dim=1)
        parts = [poses / scale, poses.diff(dim=1) / STEP_S / scale, inputs.route / 40, aside / 4]
        features = torch.cat([part.flatten(1) for part in parts], dim=1).clamp(-_OUTLIER, _OUTLIER)
        if self.tracks is not None:
            speeds = (inputs.speeds_ms / 20)[:, None, None].expand(-1, MAX_TRACKS, 1)
            each = self.tracks(torch.cat([inputs.tracks, speeds], dim=2))
            there = inputs.tracks[..., :1]
            most = each.masked_fill(there == 0, -5.0).amax(dim=1)
            features = torch.cat([features, most, (each * there).sum(dim=1) / 4], dim=1)
        if self.kind == "facts":
            assert inputs.facts is not None, "this planner needs facts"
            features = torch.cat([features, inputs.facts], dim=1)
        guesses: Guesses = self.head(self.trunk(features))
        return guesses

    @torch.inference_mode()
    def plan(self, scenes: Sequence[Scene]) -> FloatArray:
        """The best guess for each scene, float32 [n, 64, 4].

        Raises:
            SceneError: a scene has no route, or none of the tracks that the teacher needs.
        """
        inputs = small_inputs(scenes, self.kind)
        curves = self.head.curves(self(inputs).best, inputs.speeds_ms)
        trajectories = np.zeros((len(scenes), FUTURE_STEPS, 4), np.float32)
        trajectories[..., [0, 1, 3]] = curves.numpy()
        return trajectories

    def save(self, folder: Path, details: dict[str, object]) -> None:
        """Write weights and codec into ``folder``; ``details`` tell how it was made."""
        folder.mkdir(parents=True, exist_ok=True)
        about = {"version": _VERSION, "kind": self.kind, "details": details}
        state = {name: value.contiguous() for name, value in self.state_dict().items()}
        save_file(state, folder / WEIGHTS_FILE, metadata={"looktwice": json.dumps(about)})
        self.codec.save(folder)


def small_inputs(scenes: Sequence[Scene], kind: SmallKind) -> SmallInputs:
    """What a small planner sees of scenes; raises `SceneError` for what a scene lacks."""
    for scene in scenes:
        if scene.route is None:
            raise SceneError(f"scene {scene.scene_id} has no route, which small planners need")
        if kind == "teacher" and scene.tracks is None:
            raise SceneError(f"scene {scene.scene_id} has no tracks, which the teacher needs")
    routes = np.stack([np.asarray(scene.route) for scene in scenes])
    return SmallInputs(
        torch.from_numpy(np.stack([scene.history for scene in scenes])),
        torch.from_numpy(routes),
        torch.from_numpy(np.stack([track_features(scene.tracks or (), scene.route) for scene in scenes])),
    )


def load_small(folder: Path) -> SmallPlanner:
    """Read what `SmallPlanner.save` wrote; raises `SmallPlannerError`."""
    path = folder / WEIGHTS_FILE
    if not path.is_file():
        raise SmallPlannerError(f"{folder} has no {WEIGHTS_FILE}: train one with `looktwice train blind`")
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads((file.metadata() or {}).get("looktwice", "{}"))
        if about.get("version") != _VERSION or about.get("kind") not in DRIVING_KINDS:
            found = about.get("version")
            raise SmallPlannerError(f"{path} has version {found}; this LookTwice reads {_VERSION}")
        planner = SmallPlanner(about["kind"], TrajectoryCodec.load(folder))
        planner.load_state_dict(load_file(path))
    except (SafetensorError, CodecError, json.JSONDecodeError, RuntimeError) as error:
        raise SmallPlannerError(f"{path} is damaged: {error}") from error
    return planner.eval()
