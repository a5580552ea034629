"""Training of the small planners: minutes on one core, resumable by starting again."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from looktwice.model.driving.facts import mirrored
from looktwice.model.driving.scene_store import read_scenes, scene_files
from looktwice.model.driving.tracks import tracks_of
from looktwice.model.driving.trajectory import POSE_MIRROR, FloatArray
from looktwice.model.network.codec import TrajectoryCodec
from looktwice.model.network.small_planner import SmallInputs, SmallKind, SmallPlanner
from looktwice.model.network.track_features import MIRRORED, track_features

_POSE_MIRROR = torch.from_numpy(POSE_MIRROR)


@dataclass(frozen=True)
class SmallSettings:
    """How a small planner is trained.

    Attributes:
        steps, batch_size: how long.
        learning_rate, weight_decay: of AdamW; cosine decay to zero behind a short warm-up.
        dropout: of the trunk.
        own_share: of a batch that is of the planner's own states, where there are any.
        seed: of order and weights.
    """

    steps: int = 8000
    batch_size: int = 256
    learning_rate: float = 1e-3
    weight_decay: float = 0.03
    dropout: float = 0.2
    own_share: float = 0.4
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
        """The scenes of files or folders that have a route; raises ValueError where there are none."""
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
        if not columns["history"]:
            raise ValueError("there are no scenes with a route to learn from")
        history, route, tracks, future, episode = (
            torch.from_numpy(np.array(values)) for values in columns.values()
        )
        return cls(SmallInputs(history, route, tracks), future, episode)

    def joined(self, other: SmallExamples) -> SmallExamples:
        """These examples and others."""
        mine, theirs = self.inputs, other.inputs
        inputs = SmallInputs(
            torch.cat([mine.history, theirs.history]),
            torch.cat([mine.route, theirs.route]),
            torch.cat([mine.tracks, theirs.tracks]),
        )
        return SmallExamples(
            inputs, torch.cat([self.futures, other.futures]), torch.cat([self.episodes, other.episodes])
        )

    def mirrored(self) -> SmallExamples:
        """The same scenes with left and right swapped."""
        inputs = self.inputs
        tracks = inputs.tracks.clone()
        tracks[..., list(MIRRORED)] *= -1
        facts = None if inputs.facts is None else torch.from_numpy(mirrored(inputs.facts.numpy()))
        swapped = SmallInputs(inputs.history * _POSE_MIRROR, inputs.route * _POSE_MIRROR[:2], tracks, facts)
        return SmallExamples(swapped, self.futures * _POSE_MIRROR, self.episodes)


def fit_small(
    kind: SmallKind,
    examples: SmallExamples,
    codec: TrajectoryCodec,
    settings: SmallSettings = SmallSettings(),
    own: SmallExamples | None = None,
    on_step: Callable[[int, float], None] | None = None,
) -> SmallPlanner:
    """Train a small planner on scenes and their mirror images.

    Args:
        kind: which one.
        examples: to learn from.
        codec: whose space it plans in.
        settings: see there.
        own: examples of the planner's own states; `SmallSettings.own_share` of each batch is of them.
        on_step: told each step and the running mean of the training ADE in metres.
    """
    with torch.random.fork_rng():
        torch.manual_seed(settings.seed)
        planner = SmallPlanner(kind, codec, settings.dropout).train()
        sides = (examples, examples.mirrored())
        own_sides = None if own is None else (own, own.mirrored())
        own_count = 0 if own is None else round(settings.own_share * settings.batch_size)
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
            batch = _some(sides[step % 2], settings.batch_size - own_count)
            if own_sides is not None:
                batch = batch.joined(_some(own_sides[step % 2], own_count))
            losses = planner.head.loss(planner(batch.inputs), batch.inputs.speeds_ms, batch.futures)
            optimizer.zero_grad()
            losses["loss"].backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(planner.parameters(), 1.0)
            optimizer.step()
            running = float(losses["ade_m"]) if not step else 0.98 * running + 0.02 * float(losses["ade_m"])
            if on_step is not None:
                on_step(step + 1, running)
    return planner.eval()


def _some(examples: SmallExamples, count: int) -> SmallExamples:
    rows = torch.randint(len(examples), (count,))
    return SmallExamples(examples.inputs[rows], examples.futures[rows], examples.episodes[rows])


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
    own: Sequence[Path] = (),
    on_step: Callable[[int, float], None] | None = None,
) -> dict[str, float]:
    """Train a small planner and write it; returns its errors on validation scenes.

    Args:
        kind, codec, settings, on_step: see `fit_small`.
        scenes: files or folders of labelled scenes.
        target: folder to write.
        validation: scenes to measure it on.
        own: files or folders of scenes of its own states.
    """
    examples = SmallExamples.read(scenes)
    states = SmallExamples.read(own) if own else None
    planner = fit_small(kind, examples, codec, settings, states, on_step)
    figures: dict[str, float] = {}
    if validation is not None:
        errors = small_errors(planner, SmallExamples.read([validation]))
        figures = {"validation_ade_m": float(errors.mean()), "validation_scenes": float(len(errors))}
    about: dict[str, object] = {
        "settings": asdict(settings),
        "scenes": len(examples),
        "own_states": 0 if states is None else len(states),
        "episodes": len(set(examples.episodes.tolist())),
    }
    planner.save(target, about | figures)
    return figures
