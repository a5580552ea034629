"""Small planners without pictures: the blind one and the privileged one, which keep tables honest.

The blind planner sees history and route alone: who claims to see must beat it. The teacher sees the tracks
of everybody around as well: it tells what seeing is worth. Both plan in microseconds and train in minutes.
A third kind is given facts, true ones or those that were read from pictures: it tells what perception is
worth to a plan, and drives nowhere. A checkpoint whose reader of tracks writes sketches holds a teacher, too.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from looktwice.model.driving.facts import FACTS
from looktwice.model.driving.scene import Scene, SceneError
from looktwice.model.driving.trajectory import FUTURE_STEPS, FloatArray
from looktwice.model.driving.whole_files import written_whole
from looktwice.model.network.card import CARD_FILE, files_revision, weights_revision
from looktwice.model.network.checkpoint import load
from looktwice.model.network.codec import CODEC_FILE, CodecError, TrajectoryCodec
from looktwice.model.network.intent import IntentTrunk, TrackPool
from looktwice.model.network.motion import present_speeds
from looktwice.model.network.track_features import track_features
from looktwice.model.network.trajectory_head import Guesses, TrajectoryHead

SmallKind = Literal["blind", "teacher", "facts"]
DRIVING_KINDS: Final[tuple[SmallKind, ...]] = ("blind", "teacher")
WEIGHTS_FILE: Final = "planner.safetensors"
_VERSION: Final = 2


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
        return present_speeds(self.history)


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
        self.pool = TrackPool() if kind == "teacher" else None
        around = {"blind": 0, "teacher": TrackPool.size, "facts": len(FACTS)}[kind]
        self.trunk = IntentTrunk(around, dropout)
        self.head = TrajectoryHead(IntentTrunk.width, codec)

    def forward(self, inputs: SmallInputs) -> Guesses:
        """Guesses for a batch."""
        around = None
        if self.pool is not None:
            around = self.pool(inputs.tracks, inputs.history)
        elif self.kind == "facts":
            assert inputs.facts is not None, "this planner needs facts"
            around = inputs.facts
        has_route = torch.ones(len(inputs.route), dtype=torch.bool, device=inputs.route.device)
        guesses: Guesses = self.head(self.trunk(inputs.history, inputs.route, has_route, around))
        return guesses

    @torch.inference_mode()
    def plan(self, scenes: Sequence[Scene], facts: Tensor | None = None) -> FloatArray:
        """The best guess for each scene, float32 [n, 64, 4]; ``facts`` as in `SmallInputs`.

        Raises:
            SceneError: a scene has no route, or none of the tracks that the teacher needs.
        """
        inputs = replace(small_inputs(scenes, self.kind), facts=facts)
        curves = self.head.curves(self(inputs).best, inputs.speeds_ms)
        trajectories = np.zeros((len(scenes), FUTURE_STEPS, 4), np.float32)
        trajectories[..., [0, 1, 3]] = curves.numpy()
        return trajectories

    def save(self, folder: Path, details: dict[str, object]) -> None:
        """Write codec and weights into ``folder``; ``details`` tell how it was made.

        The weights come last, and are whole or not there: a folder that has them is complete.
        """
        folder.mkdir(parents=True, exist_ok=True)
        self.codec.save(folder)
        about = {"version": _VERSION, "kind": self.kind, "details": details}
        state = {name: value.contiguous() for name, value in self.state_dict().items()}
        with written_whole(folder / WEIGHTS_FILE) as temporary:
            save_file(state, temporary, metadata={"looktwice": json.dumps(about)})


def small_inputs(scenes: Sequence[Scene], kind: SmallKind) -> SmallInputs:
    """What a small planner sees of scenes; raises `SceneError` for what a scene lacks."""
    history, route = motion_of(scenes)
    for scene in scenes:
        if kind == "teacher" and scene.tracks is None:
            raise SceneError(f"scene {scene.scene_id} has no tracks, which the teacher needs")
    return SmallInputs(
        history,
        route,
        torch.from_numpy(np.stack([track_features(scene.tracks or (), scene.route) for scene in scenes])),
    )


def motion_of(scenes: Sequence[Scene]) -> tuple[Tensor, Tensor]:
    """History [n, 16, 4] and route [n, 20, 2] of scenes; raises `SceneError` for one without a route."""
    for scene in scenes:
        if scene.route is None:
            raise SceneError(f"scene {scene.scene_id} has no route, which small planners need")
    return (
        torch.from_numpy(np.stack([scene.history for scene in scenes])),
        torch.from_numpy(np.stack([np.asarray(scene.route) for scene in scenes])),
    )


def load_small(folder: Path) -> SmallPlanner:
    """Read what `SmallPlanner.save` wrote, or a checkpoint's reader of tracks with its sketches.

    Raises:
        SmallPlannerError: the folder holds neither.
        CheckpointError: it holds a checkpoint that cannot be read.
    """
    path = folder / WEIGHTS_FILE
    if not path.is_file() and (folder / CARD_FILE).is_file():
        return _reader_of_tracks(folder)
    if not path.is_file():
        raise SmallPlannerError(f"{folder} has no {WEIGHTS_FILE}: train one with `looktwice train blind`")
    kind, _ = how_it_was_made(folder)
    try:
        planner = SmallPlanner(kind, TrajectoryCodec.load(folder))
        planner.load_state_dict(load_file(path))
    except (SafetensorError, CodecError, RuntimeError) as error:
        raise SmallPlannerError(f"{path} is damaged: {error}") from error
    return planner.eval()


def how_it_was_made(folder: Path) -> tuple[SmallKind, dict[str, object]]:
    """The kind of the planner that `SmallPlanner.save` wrote into ``folder``, and its details.

    Raises:
        SmallPlannerError: its weights are damaged, of another version, or of a kind that does not drive.
    """
    path = folder / WEIGHTS_FILE
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads((file.metadata() or {}).get("looktwice", "{}"))
    except (SafetensorError, json.JSONDecodeError) as error:
        raise SmallPlannerError(f"{path} is damaged: {error}") from error
    if (found := about.get("version")) != _VERSION:
        raise SmallPlannerError(f"{path} has version {found}; this LookTwice reads {_VERSION}")
    if (kind := about["kind"]) not in DRIVING_KINDS:
        raise SmallPlannerError(f"{path} is a planner of {kind}, which drives nowhere")
    return kind, about["details"]


def _reader_of_tracks(folder: Path) -> SmallPlanner:
    loaded = load(folder)
    reader = loaded.model.track_reader
    if reader is None or reader.sketch is None:
        raise SmallPlannerError(
            f"{folder}: this checkpoint reads no tracks or sketches nothing from them; "
            "`looktwice train read-tracks` makes one that does"
        )
    planner = SmallPlanner("teacher", loaded.codec)
    assert planner.pool is not None
    for mine, its in (
        (planner.pool, reader.pool),
        (planner.trunk, reader.trunk),
        (planner.head.best, reader.sketch),
    ):
        mine.load_state_dict(its.state_dict())
    return planner.eval()


def small_revision(folder: Path) -> str:
    """12 hexadecimal digits that change with a small planner's weights and codec."""
    path = folder / WEIGHTS_FILE
    if not path.is_file():
        return weights_revision(folder)
    return files_revision([path, folder / CODEC_FILE])
