"""Teaching convolutions beside a frozen tower to find what is small, and the resampler to read it from them.

Who is in view is marked where it stands in the picture, so that one scene teaches hundreds of places. What
the tower sees is worked out once, as in `looktwice.model.training.fact_reading`.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.data import Dataset

from looktwice.model.driving.cameras import CAMERA_SPECS
from looktwice.model.driving.perceived import Perceived
from looktwice.model.driving.scene import CLIP_PERIOD_S
from looktwice.model.driving.trajectory import FloatArray, to_ego_frame
from looktwice.model.network.fine_vision import STRIDE
from looktwice.model.network.inputs import InputBuilder
from looktwice.model.network.matching import FINE_PX, STEP_PX, Matched
from looktwice.model.network.resampler import PICTURE_BEFORE
from looktwice.model.network.track_features import moving
from looktwice.model.network.vla import LookTwiceVla
from looktwice.model.network.vla_settings import SPOTTED, VlaSettings
from looktwice.model.training.examples import Examples, example_frames
from looktwice.model.training.fact_reading import FactDataset
from looktwice.model.training.grounding import LIGHT_SHARE, fact_loss, fact_weights, in_other_light

_KINDS: Final = {"pedestrian": 0, "vehicle": 1, "cone": 2, "barrier": 2}
"""Places among those of `SPOTTED`."""
_KIND_WEIGHTS: Final = {"pedestrian": 1.0, "vehicle": 0.3, "obstacle": 1.0}
"""Vehicles are many, and the tower sees them well."""
_UP_M: Final = {"pedestrian": 0.9, "vehicle": 0.7, "cone": 0.4, "barrier": 0.5}
"""The middle of each above the ground."""
_FOCUS: Final = 1.5
"""How much less places count that are told well (focal loss, https://arxiv.org/abs/1708.02002)."""
_NEARER_WEIGHT: Final = 3.0
_NEAR: Final = 0.05
"""Errors of a logarithm of metres below count by their square, above by their size."""
_SIDES: Final = np.array([1.0, 0.0, -1.0])
"""The left side, the middle and the right side."""
_HALF_WIDTH: Final = 0.4
"""How far from the middle the sides are looked for, as a share of the width: inside what is seen of it."""
_SAME_M: Final = 0.1
"""Who is in view and a track are the same when they stand so near each other."""
UNKNOWN: Final = -1


class FineSample(NamedTuple):
    """One scene.

    Attributes:
        tokens: float32 [v, hidden], of the tower.
        pictures: uint8 [cameras, 2, 3, h, w], the last two.
        marks: int8 [cameras, kinds, rows, columns], 1 where somebody in view stands; `UNKNOWN` everywhere in
            a scene that does not tell.
        away_log, shift, half_log: float32 [cameras, rows, columns], log(1 + metres) to the near side of whom
            stands there, how far to the right of the middle of the place, and the logarithm of half their
            width, in places.
        nearer_log: float32 [cameras, rows, columns], log of how much farther away they were in the picture
            before; NaN where it is not known.
        came: float32 [cameras, 3, rows, columns], how much farther to the right their left side, their middle
            and their right side were in the picture before, in places; NaN where they were not in it, or it
            is not known.
        history, route, has_route, facts: as in `Examples`, for one example.
    """

    tokens: npt.NDArray[np.float32]
    pictures: npt.NDArray[np.uint8]
    marks: npt.NDArray[np.int8]
    away_log: npt.NDArray[np.float32]
    shift: npt.NDArray[np.float32]
    half_log: npt.NDArray[np.float32]
    nearer_log: npt.NDArray[np.float32]
    came: npt.NDArray[np.float32]
    history: npt.NDArray[np.float32]
    route: npt.NDArray[np.float32]
    has_route: npt.NDArray[np.bool_]
    facts: npt.NDArray[np.float32]


class Marks(NamedTuple):
    """Who is in view, where it stands in the pictures; see `FineSample`."""

    marks: npt.NDArray[np.int8]
    away_log: npt.NDArray[np.float32]
    shift: npt.NDArray[np.float32]
    half_log: npt.NDArray[np.float32]
    nearer_log: npt.NDArray[np.float32]
    came: npt.NDArray[np.float32]


class FineDataset(Dataset[FineSample]):
    """The scenes of a `FactDataset` with their pictures, by chance in another light.

    Args:
        facts: says which side each is looked at, and what there is to read.
        examples: the same, with pictures.
        inputs: of the network that learns.
    """

    def __init__(self, facts: FactDataset, examples: Examples, inputs: InputBuilder) -> None:
        self._facts, self._examples, self._inputs = facts, examples, inputs

    def __len__(self) -> int:
        return len(self._facts)

    def __getitem__(self, index: int) -> FineSample:
        look = self._facts.chance(index)
        facts = self._facts.taken(look)
        settings, examples = self._inputs.settings, self._examples
        frames = example_frames(examples, index, look.mirror, self._inputs, latest=2)
        if self._facts.random.random() < LIGHT_SHARE:
            frames = in_other_light(frames, self._facts.random)
        pictures = frames.reshape(len(settings.cameras), 2, *frames.shape[1:]).transpose(0, 1, 4, 2, 3)
        perceived = examples.perception(index)
        faces = faces_of(perceived, examples.tracks[index], examples.history[index])
        marked_so = marked(perceived, faces, settings, mirror=look.mirror)
        return FineSample(
            facts.tokens,
            np.ascontiguousarray(pictures),
            *marked_so,
            facts.history,
            facts.route,
            facts.has_route,
            facts.facts,
        )


def marked(perceived: Perceived | None, faces: FloatArray, settings: VlaSettings, *, mirror: bool) -> Marks:
    """What is to be found in a scene's latest pictures.

    Args:
        perceived: who is in view; None where it is not known.
        faces: how they moved, see `faces_of`.
        settings: of the network, which say how pictures are cut.
        mirror: whether the pictures are mirrored.
    """
    rows, columns = (-(-size // STRIDE) for size in (settings.image_height, settings.image_width))
    cameras = len(settings.cameras)
    marks = np.zeros((cameras, len(SPOTTED), rows, columns), np.int8)
    away_log, shift, half_log = np.zeros((3, cameras, rows, columns), np.float32)
    nearer_log = np.full((cameras, rows, columns), np.nan, np.float32)
    came = np.full((cameras, len(_SIDES), rows, columns), np.nan, np.float32)
    found = Marks(marks, away_log, shift, half_log, nearer_log, came)
    if perceived is None:
        marks[:] = UNKNOWN
        return found
    agents = list(zip(perceived.agents, faces.astype(np.float64), strict=True))
    for place, camera in enumerate(settings.cameras):
        spec = CAMERA_SPECS[camera].resized(settings.image_width)
        for agent, (half_deep_m, before_x_m, before_y_m) in reversed(agents):
            # Of two at one place the nearer one is told: it comes last.
            half_m = _HALF_WIDTH * agent.width_m
            at_m = np.array([[agent.x_m, agent.y_m], [before_x_m, before_y_m]])
            at_m[:, 1] *= -1 if mirror else 1
            away_m, left_m = spec.depth_and_left(*at_m.T)
            away_m, up_m = away_m - half_deep_m, _UP_M[agent.kind]
            if not away_m[0] > 0:
                continue
            sides_m = left_m[:, None] + half_m * _SIDES
            column_px, row_px = spec.column_and_row(away_m[:, None], sides_m, up_m)
            column, row = column_px[0, 1] / STRIDE, row_px[0, 0] / STRIDE
            if not (0 <= row < rows and 0 <= column < columns):
                continue
            at = int(row), int(column)
            marks[place, _KINDS[agent.kind], *at] = 1
            away_log[place, *at] = np.log1p(away_m[0])
            shift[place, *at] = column - at[1] - 0.5
            half_log[place, *at] = math.log(spec.focal_px * half_m / away_m[0] / STRIDE)
            if away_m[1] > 0:
                nearer_log[place, *at] = math.log(away_m[1] / away_m[0])
            was_seen = (away_m[1] > 0) & (column_px[1] >= 0) & (column_px[1] < columns * STRIDE)
            came[place, :, *at] = np.where(was_seen, (column_px[1] - column_px[0]) / STRIDE, np.nan)
    return found


def faces_of(perceived: Perceived | None, tracks: FloatArray, history: FloatArray) -> FloatArray:
    """How far before their centre those are seen, in metres, and where their centre was, [n, 3].

    That is their x_m and y_m when the picture before was taken, in the ego frame of that time; NaN of whom
    the tracks do not tell.

    Args:
        perceived: n in view; None, where it is not known, is nobody.
        tracks: [16, features], as `track_features` tells them.
        history: [16, 4], of the ego.
    """
    agents = () if perceived is None else perceived.agents
    told = moving(tracks).astype(np.float64)
    faces = np.full((len(agents), 3), np.nan, np.float32)
    for place, agent in enumerate(agents):
        faces[place, 0] = agent.length_m / 2
        off_m = np.hypot(told[:, 0] - agent.x_m, told[:, 1] - agent.y_m)
        if off_m.size and off_m.min() < _SAME_M:
            x_m, y_m, cos, sin, speed_ms = told[off_m.argmin()]
            gone_m = CLIP_PERIOD_S * speed_ms
            before = x_m - gone_m * cos, y_m - gone_m * sin, 0.0, 0.0
            faces[place, 0] = (agent.length_m * abs(cos) + agent.width_m * abs(sin)) / 2
            faces[place, 1:] = to_ego_frame(before, history[PICTURE_BEFORE])[:2]
    return faces


class FineLearner(nn.Module):
    """The convolutions, and what the resampler reads of them; outputs the loss and its parts.

    What is gathered from the tower's tokens stays as it is.

    Args:
        vla: these parts of it are trained in place.

    Raises:
        ValueError: the checkpoint has no convolutions.
    """

    def __init__(self, vla: LookTwiceVla) -> None:
        super().__init__()
        if vla.fine_vision is None or vla.resampler is None:
            raise ValueError("this checkpoint has no convolutions to be taught")
        # By other names than in the network, where they learn at the tower's rate: none, here.
        self.finder, self.reader = vla.fine_vision, vla.resampler.requires_grad_(False)
        reader = self.reader
        for part in (reader.spotted, reader.people_layers, reader.fine_layer, reader.facts):
            part.requires_grad_(True)
        self.register_buffer("fact_weights", fact_weights(fine=True))
        kinds = torch.tensor([_KIND_WEIGHTS[kind] for kind in SPOTTED])
        self.register_buffer("kind_weights", kinds.view(-1, 1, 1))
        of_spotted = kinds.repeat_interleave(torch.tensor([*SPOTTED.values()]))
        self.register_buffer("spotted_weights", of_spotted.repeat_interleave(len(_SIDES)))

    fact_weights: Tensor
    kind_weights: Tensor
    spotted_weights: Tensor

    def forward(
        self,
        tokens: Tensor,
        pictures: Tensor,
        marks: Tensor,
        away_log: Tensor,
        shift: Tensor,
        half_log: Tensor,
        nearer_log: Tensor,
        came: Tensor,
        history: Tensor,
        route: Tensor,
        has_route: Tensor,
        facts: Tensor,
    ) -> dict[str, Tensor]:
        """The loss of a batch of `FineSample`, and its parts without gradients."""
        clips = pictures.flatten(0, 1)
        found = self.finder.find(clips)
        marks = marks.flatten(0, 1)
        find_loss = _focal_loss(found.logits.float(), marks, self.kind_weights)
        somebody = (marks == 1).any(dim=1)
        off = _off(found.away_log, away_log) + _off(found.shift, shift) + _off(found.half_log, half_log)
        away_loss = (off * somebody).sum() / somebody.sum().clamp_min(1)
        known = torch.isfinite(nearer_log).view_as(found.nearer_log)
        off = _off(found.nearer_log, nearer_log.nan_to_num()) * known
        nearer_loss = off.sum() / known.sum().clamp_min(1)
        places = found.spotted[:, None].expand(-1, len(_SIDES), -1)
        came_from = came.flatten(0, 1).flatten(2).gather(2, places).transpose(1, 2)
        came_loss = _came_loss(found.matched, STRIDE * came_from.flatten(1), self.spotted_weights)
        fine = self.finder.tokens(found).float()
        coarse = tokens.view(len(clips), -1, tokens.shape[-1])
        seen = torch.cat([coarse, fine], dim=1).view(len(pictures), -1, tokens.shape[-1])
        read = self.reader.facts(self.reader.gather(seen, history, route, has_route))
        of_facts = fact_loss(read, facts, self.fact_weights)
        return {
            "loss": of_facts + find_loss + away_loss + _NEARER_WEIGHT * nearer_loss + came_loss,
            "fact_loss": of_facts.detach(),
            "find_loss": find_loss.detach(),
            "away_error_log": away_loss.detach(),
            "nearer_error_log": nearer_loss.detach(),
            "came_loss": came_loss.detach(),
        }


def _off(told: Tensor, true: Tensor) -> Tensor:
    return F.smooth_l1_loss(told.float(), true.view_as(told), reduction="none", beta=_NEAR)


def _came_loss(matched: Matched, came_px: Tensor, weights: Tensor) -> Tensor:
    """Of where somebody was, in pixels [k, n]; NaN counts nothing, others by their weights [n]."""
    coarse = _step_loss(matched.coarse, came_px / STEP_PX, weights)
    return coarse + _step_loss(matched.fine, (came_px - matched.base_px) / FINE_PX, weights)


def _step_loss(logits: Tensor, step: Tensor, weights: Tensor) -> Tensor:
    """Of logits [k, n, steps], the middle one standing for none, and true steps [k, n]."""
    steps = torch.arange(logits.shape[-1], device=logits.device) - logits.shape[-1] // 2
    known = torch.isfinite(step) & (step.abs() <= logits.shape[-1] // 2)
    away = (torch.where(known, step, 0.0)[..., None] - steps).abs()
    wrong = -((1 - away).clamp_min(0) * logits.float().log_softmax(-1)).sum(-1)  # two neighbours share it
    return (wrong * known * weights).sum() / (known * weights).sum().clamp_min(1)


def _focal_loss(logits: Tensor, marks: Tensor, kind_weights: Tensor) -> Tensor:
    """Of logits [k, kinds, rows, columns], a sum over places for each that is marked.

    Places beside a marked one do not count: who stands near a border is seen in both.
    """
    there = (marks == 1).float()
    near = F.max_pool2d(there, 3, 1, 1)
    counts = ((marks != UNKNOWN) & (near == there)) * kind_weights
    wrong = F.binary_cross_entropy_with_logits(logits, there, reduction="none")
    probability = logits.sigmoid()
    missed = (there * (1 - probability) + (1 - there) * probability) ** _FOCUS
    return (wrong * missed * counts).sum() / there.sum().clamp_min(1)
