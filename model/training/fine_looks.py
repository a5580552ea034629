"""Teaching convolutions beside a frozen tower to find what is small, and the resampler to read it from them.

Who is in view is marked where it stands in the picture, so that one scene teaches hundreds of places. What
the tower sees is worked out once, as in `looktwice.model.training.fact_reading`.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.data import Dataset

from looktwice.model.driving.cameras import CAMERA_SPECS
from looktwice.model.driving.facts import FACTS
from looktwice.model.driving.perceived import Perceived
from looktwice.model.network.fine_vision import STRIDE
from looktwice.model.network.inputs import InputBuilder
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
_SMALL_TIMES: Final = 5.0
"""How much more facts of people and obstacles count: there are seventy others, which the tower tells well."""
_NEAR: Final = 0.05
"""Errors of a logarithm of metres below count by their square, above by their size."""
UNKNOWN: Final = -1


class FineSample(NamedTuple):
    """One scene.

    Attributes:
        tokens: float32 [v, hidden], of the tower.
        pictures: uint8 [cameras, 2, 3, h, w], the last two.
        marks: int8 [cameras, kinds, rows, columns], 1 where somebody in view stands; `UNKNOWN` everywhere in
            a scene that does not tell.
        away_log, shift: float32 [cameras, rows, columns], log(1 + metres) to whom stands there, and how far
            beside the middle of the place, in places.
        history, route, has_route, facts: as in `Examples`, for one example.
    """

    tokens: npt.NDArray[np.float32]
    pictures: npt.NDArray[np.uint8]
    marks: npt.NDArray[np.int8]
    away_log: npt.NDArray[np.float32]
    shift: npt.NDArray[np.float32]
    history: npt.NDArray[np.float32]
    route: npt.NDArray[np.float32]
    has_route: npt.NDArray[np.bool_]
    facts: npt.NDArray[np.float32]


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
        marked_so = marked(examples.perception(index), settings, mirror=look.mirror)
        return FineSample(
            facts.tokens,
            np.ascontiguousarray(pictures),
            *marked_so,
            facts.history,
            facts.route,
            facts.has_route,
            facts.facts,
        )


def marked(
    perceived: Perceived | None, settings: VlaSettings, *, mirror: bool
) -> tuple[npt.NDArray[np.int8], npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """``marks``, ``away_log`` and ``shift`` of those in view; see `FineSample`."""
    rows, columns = (-(-size // STRIDE) for size in (settings.image_height, settings.image_width))
    cameras = len(settings.cameras)
    marks = np.zeros((cameras, len(SPOTTED), rows, columns), np.int8)
    away_log, shift = np.zeros((2, cameras, rows, columns), np.float32)
    if perceived is None:
        marks[:] = UNKNOWN
        return marks, away_log, shift
    for place, camera in enumerate(settings.cameras):
        spec = CAMERA_SPECS[camera].resized(settings.image_width)
        for agent in perceived.agents:
            left_m = -agent.y_m if mirror else agent.y_m
            column, row, away_m = spec.project(np.array([[agent.x_m, left_m, _UP_M[agent.kind]]]))[0]
            at = int(row // STRIDE), int(column // STRIDE)
            if away_m > 0 and 0 <= at[0] < rows and 0 <= at[1] < columns:
                marks[place, _KINDS[agent.kind], *at] = 1
                away_log[place, *at] = np.log1p(away_m)
                shift[place, *at] = column / STRIDE - at[1] - 0.5
    return marks, away_log, shift


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
        for part in (self.reader.spotted, self.reader.fine_layer, self.reader.facts):
            part.requires_grad_(True)
        small = torch.tensor([name.startswith("walker") or "obstacle" in name for name in FACTS])
        self.register_buffer("fact_weights", torch.where(small, _SMALL_TIMES, 1.0) * fact_weights())
        kinds = torch.tensor([_KIND_WEIGHTS[kind] for kind in SPOTTED])
        self.register_buffer("kind_weights", kinds.view(-1, 1, 1))

    fact_weights: Tensor
    kind_weights: Tensor

    def forward(
        self,
        tokens: Tensor,
        pictures: Tensor,
        marks: Tensor,
        away_log: Tensor,
        shift: Tensor,
        history: Tensor,
        route: Tensor,
        has_route: Tensor,
        facts: Tensor,
    ) -> dict[str, Tensor]:
        """The loss of a batch of `FineSample`, and its parts without gradients."""
        clips = pictures.flatten(0, 1)
        features = self.finder.features(self.finder.changing(clips))
        found = self.finder.find(features)
        marks = marks.flatten(0, 1)
        find_loss = _focal_loss(found.logits.float(), marks, self.kind_weights)
        somebody = (marks == 1).any(dim=1)
        off = _off(found.away_log, away_log) + _off(found.shift, shift)
        away_loss = (off * somebody).sum() / somebody.sum().clamp_min(1)
        fine = self.finder.spotted(features, found).float()
        coarse = tokens.view(len(clips), -1, tokens.shape[-1])
        seen = torch.cat([coarse, fine], dim=1).view(len(pictures), -1, tokens.shape[-1])
        read = self.reader.facts(self.reader.gather(seen, history, route, has_route))
        of_facts = fact_loss(read, facts, self.fact_weights)
        return {
            "loss": of_facts + find_loss + away_loss,
            "fact_loss": of_facts.detach(),
            "find_loss": find_loss.detach(),
            "away_error_log": away_loss.detach(),
        }


def _off(told: Tensor, true: Tensor) -> Tensor:
    return F.smooth_l1_loss(told.float(), true.view_as(told), reduction="none", beta=_NEAR)


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
