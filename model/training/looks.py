"""Grounding with all pictures in an accelerator's memory.

A tower learns from thousands of looks a second there, and processes that decode JPEG beside it give it one in
four of them. So each picture is decoded once, and a batch is chosen, mirrored and lit where it is learned.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from looktwice.model.driving.facts import mirrored
from looktwice.model.driving.trajectory import POSE_MIRROR
from looktwice.model.network.inputs import InputBuilder
from looktwice.model.network.patches import PATCH_ORDER, patch_grid, patch_width
from looktwice.model.network.vla_settings import VlaSettings
from looktwice.model.training.examples import Examples
from looktwice.model.training.grounding import (
    GAIN,
    LIFT,
    LIGHT_SHARE,
    MIRROR_SHARE,
    NOISE,
    ROUTE_SHARE,
    TONE,
    GroundingLearner,
)

_BATCH: Final = 64


class LookLearner(nn.Module):
    """Grounds on places of examples alone; what is seen and known there is kept on a device.

    Args:
        learner: that learns from the batches made here.
        examples: all, with pictures or without.
        inputs: of the checkpoint.
        device: where everything is kept; about 170 kB a picture.
        workers: processes that decode the pictures.
    """

    def __init__(
        self,
        learner: GroundingLearner,
        examples: Examples,
        inputs: InputBuilder,
        device: torch.device,
        workers: int = 0,
    ) -> None:
        super().__init__()
        self.learner = learner
        self._settings = inputs.settings
        spans, which = np.unique(examples.picture_spans.reshape(-1, 2), axis=0, return_inverse=True)
        self._pictures = _decoded(examples, spans, inputs, device, workers)
        # [N, cameras x frames], into the pictures.
        self._which = torch.from_numpy(which.reshape(len(examples), -1)).to(device)
        facts = np.stack([examples.facts, mirrored(examples.facts)])
        # [plain and mirrored, N, facts].
        self._facts = torch.from_numpy(facts).to(device)
        self._known = {
            name: torch.from_numpy(values).to(device)
            for name, values in {
                "classes": examples.dense_classes,
                "range_log": examples.dense_range_log,
                "motion": examples.dense_motion,
                "history": examples.history,
                "route": np.nan_to_num(examples.route),
                "has_route": examples.has_route,
                "futures": examples.future,
            }.items()
        }

    def forward(self, places: Tensor) -> dict[str, Tensor]:
        """The loss of examples at ``places`` int64 [b], and its parts; see `GroundingLearner`."""
        chance = torch.rand(3, len(places), device=places.device)
        batch = self.look(
            places,
            mirror=chance[0] < MIRROR_SHARE,
            route=chance[1] < ROUTE_SHARE,
            lit=chance[2] < LIGHT_SHARE,
        )
        losses: dict[str, Tensor] = self.learner(**batch)
        return losses

    def look(self, places: Tensor, *, mirror: Tensor, route: Tensor, lit: Tensor) -> dict[str, Tensor]:
        """A batch as `collate_grounding` makes it; each bool [b] says for which examples it holds."""
        known = {name: values[places] for name, values in self._known.items()}
        frames = self._pictures[self._which[places]]
        frames = _where(mirror, frames.flip(-2), frames)
        frames = _where(lit, in_other_lights(frames), frames)
        motion = known["motion"].float()
        sideways = motion.new_tensor([1.0, -1.0])[:, None, None]
        poses = torch.from_numpy(POSE_MIRROR).to(places.device)
        return {
            "patches": patchified(frames.flatten(0, 1), self._settings),
            "classes": _where(mirror, known["classes"].flip(-1), known["classes"]),
            "range_log": _where(mirror, known["range_log"].flip(-1), known["range_log"]).float(),
            "motion": _where(mirror, motion.flip(-1) * sideways, motion),
            "facts": self._facts[mirror.long(), places],
            "history": _where(mirror, known["history"] * poses, known["history"]),
            "route": _where(mirror, known["route"] * poses[:2], known["route"]),
            "has_route": known["has_route"] & route,
            "futures": _where(mirror, known["futures"] * poses, known["futures"]),
        }


def in_other_lights(frames: Tensor) -> Tensor:
    """Pictures uint8 [b, f, h, w, 3], each scene's in a light of its own; see `in_other_light`."""

    def chance(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(len(frames), *shape, device=frames.device)

    tone = 1 + chance(0, TONE, 1, 1, 1, 1) * chance(-1, 1, 1, 1, 1, 3)
    gain, lift = chance(1 - GAIN, 1 + GAIN, 1, 1, 1, 1), chance(-LIFT, LIFT, 1, 1, 1, 1)
    noise = torch.randint(-NOISE, NOISE + 1, frames.shape, dtype=torch.int8, device=frames.device)
    return (frames * (gain * tone) + lift + noise).round().clamp(0, 255).to(torch.uint8)


def patchified(frames: Tensor, settings: VlaSettings) -> Tensor:
    """As `patchify`, on a device: uint8 [f, h, w, 3] to patches [p, 3 x temporal x patch x patch]."""
    parts = frames.reshape(patch_grid(frames.shape, settings)).permute(PATCH_ORDER)
    return parts.reshape(-1, patch_width(settings))


def _where(which: Tensor, there: Tensor, elsewhere: Tensor) -> Tensor:
    """Rows of ``there`` [b, ...] where bool [b] holds, else those of ``elsewhere``."""
    return torch.where(which.view(-1, *[1] * (there.ndim - 1)), there, elsewhere)


class _DecodedPictures(Dataset[npt.NDArray[np.uint8]]):
    """Pictures of examples by their spans [n, 2], decoded; an empty one is black."""

    def __init__(self, examples: Examples, spans: npt.NDArray[np.int64], inputs: InputBuilder) -> None:
        self._pictures, self._spans, self._inputs = examples.pictures, spans, inputs

    def __len__(self) -> int:
        return len(self._spans)

    def __getitem__(self, place: int) -> npt.NDArray[np.uint8]:
        settings = self._inputs.settings
        first, last = self._spans[place]
        if first == last:
            return np.zeros((settings.image_height, settings.image_width, 3), np.uint8)
        return self._inputs.frame(self._pictures[first:last].tobytes())


def _decoded(
    examples: Examples,
    spans: npt.NDArray[np.int64],
    inputs: InputBuilder,
    device: torch.device,
    workers: int,
) -> Tensor:
    """Pictures uint8 [n, h, w, 3] on a device."""
    settings = inputs.settings
    shape = (len(spans), settings.image_height, settings.image_width, 3)
    pictures = torch.empty(shape, dtype=torch.uint8, device=device)
    decoded = _DecodedPictures(examples, spans, inputs)
    loader = DataLoader(decoded, _BATCH, collate_fn=np.stack, num_workers=workers)
    for number, batch in enumerate(loader):
        pictures[number * _BATCH :][: len(batch)] = torch.from_numpy(batch).to(device)
    return pictures
