"""Grounding: the vision tower and the resampler learn what the simulator knows about a scene.

All frames of each camera go through the tower; small heads predict for every vision token what the cells
it covers show, how far that is and how it moves (dense, so one picture teaches thousands of things). From
what the resampler gathers, other heads tell the facts of `looktwice.model.driving.facts`, by which perception
is judged, and the expert's trajectory, so that what a plan needs is gathered. The heads are kept beside the
checkpoint: `looktwice evaluate --perception` reads with them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.data import Dataset

from looktwice.model.driving.facts import (
    FACTS,
    IS_YES_OR_NO,
    mirrored,
)
from looktwice.model.driving.scene import SEMANTIC_CLASSES
from looktwice.model.driving.trajectory import POSE_MIRROR
from looktwice.model.network.codec import TrajectoryCodec
from looktwice.model.network.fact_reader import likely
from looktwice.model.network.inputs import InputBuilder
from looktwice.model.network.intent import IntentTrunk
from looktwice.model.network.motion import present_speeds
from looktwice.model.network.patches import patchify
from looktwice.model.network.trajectory_head import TrajectoryHead
from looktwice.model.network.vla import LookTwiceVla
from looktwice.model.training.dense import FIRST_AGENT_CLASS, UNLABELLED
from looktwice.model.training.examples import Examples, example_frames

_CLASSES: Final = len(SEMANTIC_CLASSES)
_CLASS_WEIGHTS: Final = (0.3, 0.5, 0.5, 3.0, 6.0, 4.0)
"""Sky and road fill most pictures; what matters is small."""
_AGENT_RANGE_WEIGHT: Final = 5.0
_MOTION_WEIGHT: Final = 2.0
_FACT_WEIGHT: Final = 6.0
"""Brings the mean over facts level with the other losses."""
_FIELD_WEIGHTS: Final = {"speed": 4.0, "speed_left": 4.0, "gap_log_m": 2.0}
_SECOND_RANK_WEIGHT: Final = 0.5
_SMALL_TIMES: Final = 4.0
_NEAR: Final = 0.05
"""Errors below count by their square, above by their size."""
_PLAN_WEIGHT: Final = 0.3
_RARE: Final = [FACTS.index(name) for name in ("walker_0_present", "own_obstacle_present")]
RARE_TIMES: Final = 3
"""How often a scene with a walker or an obstacle ahead is looked at while others are looked at once: one in
seven has either, and cars that plan from pictures mostly collide with these."""
ROUTE_SHARE: Final = 0.75
MIRROR_SHARE: Final = 0.5
LIGHT_SHARE: Final = 0.7
GAIN: Final = 0.15
TONE: Final = 0.12
LIFT: Final = 10.0
NOISE: Final = 2
"""Of pictures in another light: how far brightness changes as a share, single colours beside it, what is
added to all levels, and the largest noise in levels."""


class GroundingSample(NamedTuple):
    """One scene: what is seen, and what is known. Shapes as in `Examples`, for one example."""

    patches: np.ndarray[Any, np.dtype[np.uint8]]
    classes: np.ndarray[Any, np.dtype[np.uint8]]
    range_log: np.ndarray[Any, np.dtype[np.float32]]
    motion: np.ndarray[Any, np.dtype[np.float32]]
    facts: np.ndarray[Any, np.dtype[np.float32]]
    history: np.ndarray[Any, np.dtype[np.float32]]
    route: np.ndarray[Any, np.dtype[np.float32]]
    has_route: np.ndarray[Any, np.dtype[np.bool_]]
    futures: np.ndarray[Any, np.dtype[np.float32]]


@dataclass(frozen=True)
class GroundingItem:
    """Which example to look at, and how.

    Attributes:
        index: of the example.
        mirror: left and right are swapped.
        route: the route is given, where the example has one.
    """

    index: int
    mirror: bool = False
    route: bool = True


class GroundingDataset(Dataset[GroundingSample]):
    """All examples, each time mirrored or not, with or without its route, and in another light, by chance."""

    def __init__(self, examples: Examples, inputs: InputBuilder, seed: int = 0) -> None:
        self._examples, self._inputs = examples, inputs
        self.random = np.random.default_rng(seed)

    def __len__(self) -> int:
        return len(self._examples)

    def __getitem__(self, index: int) -> GroundingSample:
        chance = self.random.random(3)
        look = GroundingItem(index, bool(chance[0] < MIRROR_SHARE), bool(chance[1] < ROUTE_SHARE))
        return self.look(look, self.random if chance[2] < LIGHT_SHARE else None)

    def look(self, look: GroundingItem, light: np.random.Generator | None = None) -> GroundingSample:
        """One example as it is asked for, in a light by chance or, without one, as it was."""
        examples, index = self._examples, look.index
        history, way, has_route = examples.motion(index, mirror=look.mirror, route=look.route)
        frames = example_frames(examples, index, look.mirror, self._inputs)
        if light is not None:
            frames = in_other_light(frames, light)
        sample = GroundingSample(
            patchify(frames, self._inputs.settings),
            examples.dense_classes[index],
            examples.dense_range_log[index].astype(np.float32),
            examples.dense_motion[index].astype(np.float32),
            examples.facts[index],
            history,
            way,
            np.array(has_route),
            examples.future[index],
        )
        return _mirror(sample) if look.mirror else sample


def in_other_light(frames: npt.NDArray[np.uint8], random: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Pictures uint8 [f, h, w, 3] brighter or darker and in another tone, all alike, with noise."""
    tone = 1 + random.uniform(0, TONE) * random.uniform(-1, 1, 3)
    gain, lift = 1 + random.uniform(-GAIN, GAIN), random.uniform(-LIFT, LIFT)
    noise = random.integers(-NOISE, NOISE + 1, frames.shape, dtype=np.int8)
    lit = frames * (gain * tone).astype(np.float32) + (np.float32(lift) + noise)
    return lit.round().clip(0, 255).astype(np.uint8)


def _mirror(sample: GroundingSample) -> GroundingSample:
    """What is known, for pictures and a motion that are mirrored already."""
    motion = sample.motion[..., ::-1].copy()
    motion[:, 1] *= -1
    return sample._replace(
        classes=np.ascontiguousarray(sample.classes[..., ::-1]),
        range_log=np.ascontiguousarray(sample.range_log[..., ::-1]),
        motion=motion,
        facts=mirrored(sample.facts),
        futures=sample.futures * POSE_MIRROR,
    )


def looked_at(examples: Examples) -> list[int]:
    """Places of the examples with pictures, once an epoch each; rare ones `RARE_TIMES`."""
    pictured = np.flatnonzero(examples.pictured)
    rare = pictured[(examples.facts[pictured][:, _RARE] == 1).any(axis=1)]
    return [*pictured.tolist(), *(rare.tolist() * (RARE_TIMES - 1))]


def collate_grounding(samples: list[GroundingSample]) -> dict[str, Tensor]:
    """Stack grounding samples; patches of all lie one after the other."""
    columns = dict(zip(GroundingSample._fields, zip(*samples, strict=True), strict=True))
    patches = torch.from_numpy(np.concatenate(columns.pop("patches")))
    return {"patches": patches} | {
        name: torch.from_numpy(np.stack(values)) for name, values in columns.items()
    }


class GroundingLearner(nn.Module):
    """Tower and resampler with their heads; outputs the loss and its parts.

    Args:
        vla: its tower and its resampler are trained in place.
        codec: of the checkpoint.
        dense_shape: rows and columns of the dense targets; whole multiples of the vision tokens' grid.
    """

    def __init__(self, vla: LookTwiceVla, codec: TrajectoryCodec, dense_shape: tuple[int, int]) -> None:
        super().__init__()
        settings = vla.settings
        if vla.resampler is None:
            raise ValueError("grounding needs a checkpoint with a resampler (scene_tokens > 0)")
        # Registered by their own names: the decoder is not trained here.
        self.visual, self.resampler = vla.model.visual, vla.resampler
        self._vla: list[LookTwiceVla] = [vla]
        slices, rows, columns = settings.grid
        merge = settings.spatial_merge_size
        self._rows, self._columns, self._slices = rows // merge, columns // merge, slices
        if dense_shape[0] % self._rows or dense_shape[1] % self._columns:
            raise ValueError(
                f"{self._rows} x {self._columns} vision tokens do not divide {dense_shape} dense cells"
            )
        self._cell = (dense_shape[0] // self._rows, dense_shape[1] // self._columns)
        text: Any = vla.config.text_config
        hidden = text.hidden_size
        self.dense_head = nn.Linear(hidden * slices, self._cell[0] * self._cell[1] * (_CLASSES + 3))
        self.trajectory = TrajectoryHead(IntentTrunk.width, codec)
        self.register_buffer("fact_weights", fact_weights())

    fact_weights: Tensor

    def gather(
        self, patches: Tensor, history: Tensor, route: Tensor, has_route: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The tower's tokens [clips, v, hidden] and gathered tokens [b, queries, hidden] of scenes."""
        vla = self._vla[0]
        settings = vla.settings
        clips = len(history) * len(settings.cameras)
        tokens = vla.vision(patches, torch.tensor([settings.grid] * clips))
        gathered = self.resampler.gather(
            tokens.view(len(history), settings.vision_tokens, -1), history, route, has_route
        )
        # Of each clip the tower's tokens come first.
        return tokens.view(clips, -1, tokens.shape[-1])[:, : settings.clip_tokens], gathered

    def forward(
        self,
        patches: Tensor,
        classes: Tensor,
        range_log: Tensor,
        motion: Tensor,
        facts: Tensor,
        history: Tensor,
        route: Tensor,
        has_route: Tensor,
        futures: Tensor,
    ) -> dict[str, Tensor]:
        """The loss of a batch from `collate_grounding`, and its parts without gradients."""
        tokens, gathered = self.gather(patches, history, route, has_route)
        dense = self._dense(tokens, classes.shape)
        labels = classes.long()
        labelled = labels != UNLABELLED
        counts = dense.new_tensor(_CLASS_WEIGHTS)[torch.where(labelled, labels, 0)] * labelled
        class_losses = F.cross_entropy(
            dense[..., :_CLASSES].flatten(0, -2), labels.flatten(), ignore_index=UNLABELLED, reduction="none"
        )
        # Scenes may come without dense targets: a batch of nothing else teaches the facts alone.
        class_loss = (class_losses * counts.flatten()).sum() / counts.sum().clamp_min(1e-6)
        agents = (labels >= FIRST_AGENT_CLASS) & labelled
        weights = torch.where(agents, _AGENT_RANGE_WEIGHT, 1.0) * (range_log > 0)
        range_error = (dense[..., _CLASSES] - range_log).abs()
        range_loss = (range_error * weights).sum() / weights.sum().clamp_min(1)
        moved = (dense[..., _CLASSES + 1 :] - motion.permute(0, 1, 3, 4, 2)).abs().sum(dim=-1)
        motion_loss = (moved * agents).sum() / agents.sum().clamp_min(1)
        read = self.resampler.facts(gathered)
        of_facts = fact_loss(read, facts, self.fact_weights)
        speeds = present_speeds(history)
        state = self.resampler.intent.state(likely(read), history, route, has_route)
        planned = self.trajectory.loss(self.trajectory(state.float()), speeds, futures)
        loss = class_loss + range_loss + _MOTION_WEIGHT * motion_loss + of_facts
        return {
            "loss": loss + _PLAN_WEIGHT * planned["loss"],
            "class_loss": class_loss.detach(),
            "range_error_log": range_loss.detach(),
            "motion_error": motion_loss.detach(),
            "fact_loss": of_facts.detach(),
            "plan_ade_m": planned["ade_m"],
        }

    def _dense(self, tokens: Tensor, shape: torch.Size) -> Tensor:
        """What every cell shows, [b, cameras, rows, columns, classes + 3], from tokens [clips, v, hidden]."""
        batch, cameras = shape[:2]
        grid = tokens.reshape(batch, cameras, self._slices, self._rows, self._columns, -1)
        # The time slices of one place side by side.
        beside = grid.permute(0, 1, 3, 4, 2, 5).flatten(4)
        dense: Tensor = self.dense_head(beside).float()
        dense = dense.view(*dense.shape[:-1], *self._cell, _CLASSES + 3)
        return dense.permute(0, 1, 2, 4, 3, 5, 6).reshape(*shape, _CLASSES + 3)


def fact_weights(*, fine: bool = False) -> Tensor:
    """How much each fact counts, [facts].

    Args:
        fine: whether convolutions look for what is small. Then that counts more: it is read from few scenes,
            and seventy other facts are told well already.
    """
    small = [name.startswith("walker") or "obstacle" in name for name in FACTS]
    times = torch.where(torch.tensor(small), _SMALL_TIMES if fine else 1.0, 1.0)
    return times * torch.tensor([_weight(name) for name in FACTS])


def _weight(name: str) -> float:
    weight = next((w for field, w in _FIELD_WEIGHTS.items() if name.endswith(field)), 1.0)
    return weight * (_SECOND_RANK_WEIGHT if "_1_" in name else 1.0)


def fact_loss(predicted: Tensor, facts: Tensor, weights: Tensor) -> Tensor:
    """How far predictions [b, facts] (logits for what is or is not so) lie from facts; NaN counts nothing."""
    known = torch.isfinite(facts)
    targets = torch.where(known, facts, 0.0)
    yes_or_no = torch.from_numpy(IS_YES_OR_NO).to(facts.device)
    losses = torch.where(
        yes_or_no,
        F.binary_cross_entropy_with_logits(predicted, targets.clamp(0, 1), reduction="none"),
        2.0 * F.smooth_l1_loss(predicted, targets, reduction="none", beta=_NEAR),
    )
    return (losses * known * weights).sum() / (known * weights).sum().clamp_min(1) * _FACT_WEIGHT
