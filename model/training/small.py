"""Training of the small planners: minutes on one core, resumable by starting again."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from model.driving.scene_store import read_scenes, scene_files
from model.driving.tracks import tracks_of
from model.driving.trajectory import FloatArray
from model.network.codec import TrajectoryCodec
from model.network.small_planner import SmallInputs, SmallKind, SmallPlanner
from model.network.track_features import MIRRORED, track_features

_POSE_MIRROR = torch.tensor([1.0, -1.0, 1.0, -1.0])


@dataclass(frozen=True)
class SmallSettings:
    """How a small planner is trained.

    Attributes:
        steps, batch_size: how long.
        learning_rate, weight_decay: of AdamW; cosine decay to zero behind a short warm-up.
        dropout: of the trunk.
        seed: of order and weights.
    """

    steps: int = 8000
    batch_size: int = 256
    learning_rate: float = 1e-3
    weight_decay: float = 0.03
    dropout: float = 0.2
    seed: int = 0


@dataclass(frozen=True, eq=False)
class SmallExamples:
    """Labelled scenes with a route, as small planners learn from them.

    Attributes:
        inputs: of n scenes.
        futures: float32 [n, 64, 4].
        episodes: int64 [n].
    """

    inputs: SmallInputs
    futures: Tensor
    episodes: torch.Tensor

    def __len__(self) -> int:
        return len(self.futures)

    @classmethod
    def read(cls, folders: Sequence[Path]) -> SmallExamples:
        """The scenes of files or folders; those without a route are left out."""
        columns: dict[str, list[FloatArray | int]] = {
            name: [] for name in ("history", "route", "tracks", "future", "episode")
        }
        for folder in folders:
            for file in scene_files(folder):
                for labelled in read_scenes(file, dense=False):
                    scene = labelled.scene
                    if scene.route is None:
                        continue
                    columns["history"].append(scene.history)
                    columns["route"].append(scene.route)
                    columns["tracks"].append(track_features(tracks_of(labelled.agents), scene.route))
                    columns["future"].append(labelled.future)
                    columns["episode"].append(labelled.seed)
        arrays = {name: np.array(values) for name, values in columns.items()}
        return cls.of_arrays(**arrays)

    @classmethod
    def of_arrays(
        cls,
        history: FloatArray,
        route: FloatArray,
        tracks: FloatArray,
        future: FloatArray,
        episode: FloatArray,
    ) -> SmallExamples:
        """From arrays [n, ...]; raises ValueError where there are none."""
        if not len(history):
            raise ValueError("there are no scenes with a route to learn from")
        inputs = SmallInputs(*(torch.from_numpy(part) for part in (history, route, tracks)))
        return cls(inputs, torch.from_numpy(future), torch.from_numpy(episode))

    def mirrored(self) -> SmallExamples:
        """The same scenes with left and right swapped."""
        inputs = self.inputs
        tracks = inputs.tracks.clone()
        tracks[..., list(MIRRORED)] *= -1
        swapped = SmallInputs(inputs.history * _POSE_MIRROR, inputs.route * _POSE_MIRROR[:2], tracks)
        return SmallExamples(swapped, self.futures * _POSE_MIRROR, self.episodes)


def fit_small(
    kind: SmallKind,
    examples: SmallExamples,
    codec: TrajectoryCodec,
    settings: SmallSettings = SmallSettings(),
    on_step: Callable[[int, float], None] | None = None,
) -> SmallPlanner:
    """Train a small planner on scenes and their mirror images.

    Args:
        kind: which one.
        examples: to learn from.
        codec: whose space it plans in.
        settings: see there.
        on_step: told each step and the running mean of the training ADE in metres.
    """
    with torch.random.fork_rng():
        torch.manual_seed(settings.seed)
        planner = SmallPlanner(kind, codec, settings.dropout).train()
        sides = (examples, examples.mirrored())
        optimizer = torch.optim.AdamW(
            planner.parameters(),
            settings.learning_rate,
            weight_decay=settings.weight_decay,
            betas=(0.9, 0.98),
        )
        warm, running = min(200, settings.steps // 4 + 1), 0.0
        for step in range(settings.steps):
            rate = settings.learning_rate * min(1.0, (step + 1) / warm)
            for group in optimizer.param_groups:
                group["lr"] = rate * 0.5 * (1 + math.cos(math.pi * step / settings.steps))
            side = sides[step % 2]
            rows = torch.randint(len(side), (settings.batch_size,))
            inputs = side.inputs[rows]
            losses = planner.head.loss(planner(inputs), inputs.speeds_ms, side.futures[rows])
            optimizer.zero_grad()
            losses["loss"].backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(planner.parameters(), 1.0)
            optimizer.step()
            running = float(losses["ade_m"]) if not step else 0.98 * running + 0.02 * float(losses["ade_m"])
            if on_step is not None:
                on_step(step + 1, running)
    return planner.eval()


@torch.inference_mode()
def small_errors(planner: SmallPlanner, examples: SmallExamples) -> Tensor:
    """The best guess's ADE in metres for every example, [n]."""
    errors = []
    for start in range(0, len(examples), 1024):
        rows = slice(start, start + 1024)
        inputs = examples.inputs[rows]
        curves = planner.head.curves(planner(inputs).best, inputs.speeds_ms)
        apart = curves[..., :2] - examples.futures[rows][..., :2]
        errors.append(apart.norm(dim=-1).mean(dim=-1))
    return torch.cat(errors)


def train_small(
    kind: SmallKind,
    scenes: Sequence[Path],
    codec: TrajectoryCodec,
    target: Path,
    settings: SmallSettings = SmallSettings(),
    validation: Path | None = None,
    on_step: Callable[[int, float], None] | None = None,
) -> dict[str, float]:
    """Train a small planner on scene folders and write it; returns its errors on validation scenes."""
    examples = SmallExamples.read(scenes)
    planner = fit_small(kind, examples, codec, settings, on_step)
    figures: dict[str, float] = {}
    if validation is not None:
        errors = small_errors(planner, SmallExamples.read([validation]))
        figures = {"validation_ade_m": float(errors.mean()), "validation_scenes": float(len(errors))}
    about: dict[str, object] = {
        "settings": asdict(settings),
        "scenes": len(examples),
        "episodes": len(set(examples.episodes.tolist())),
    }
    planner.save(target, about | figures)
    return figures
