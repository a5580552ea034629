"""Grounding: the vision tower learns what the simulator knows about a picture.

The latest pair of frames of each camera goes through the tower; small heads, thrown away afterwards, predict
for every vision token the classes and ranges of the cells it covers (dense, so one picture teaches
thousands of things), and for the whole scene the facts of `model.training.facts`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.data import Dataset

from model.driving.images import decode_image
from model.driving.scene import SEMANTIC_CLASSES
from model.network.inputs import InputBuilder
from model.network.patches import patchify, resize
from model.network.vla import LookTwiceVla
from model.training.examples import Examples
from model.training.facts import FACTS
from model.training.probe import fact_loss

_CLASSES: Final = len(SEMANTIC_CLASSES)
_CLASS_WEIGHTS: Final = (0.3, 0.5, 0.5, 3.0, 6.0, 4.0)
"""Sky and road fill most pictures; what matters is small."""
_OBJECT_RANGE_WEIGHT: Final = 5.0


@dataclass(frozen=True, eq=False)
class GroundingSample:
    """One scene's latest pictures and what they show."""

    patches: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]
    classes: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]
    range_log: np.ndarray[tuple[int, ...], np.dtype[np.float16]]
    facts: np.ndarray[tuple[int, ...], np.dtype[np.float32]]


class GroundingDataset(Dataset[GroundingSample]):
    """The latest pair of frames of every example."""

    def __init__(self, examples: Examples, inputs: InputBuilder) -> None:
        self._examples, self._inputs = examples, inputs

    def __len__(self) -> int:
        return len(self._examples)

    def __getitem__(self, index: int) -> GroundingSample:
        examples, settings = self._examples, self._inputs.settings
        cameras, frames = examples.picture_spans.shape[1:3]
        pictures = [
            resize(decode_image(examples.picture(index, camera, frame)), settings)
            for camera in range(cameras)
            for frame in range(frames - settings.temporal_patch_size, frames)
        ]
        return GroundingSample(
            patchify(np.stack(pictures), settings),
            examples.dense_classes[index],
            examples.dense_range_log[index],
            examples.facts[index],
        )


def collate_grounding(samples: list[GroundingSample]) -> dict[str, Tensor]:
    """Stack grounding samples."""
    return {
        "patches": torch.from_numpy(np.concatenate([sample.patches for sample in samples])),
        "classes": torch.from_numpy(np.stack([sample.classes for sample in samples])),
        "range_log": torch.from_numpy(np.stack([sample.range_log for sample in samples]).astype(np.float32)),
        "facts": torch.from_numpy(np.stack([sample.facts for sample in samples])),
    }


class GroundingLearner(nn.Module):
    """The vision tower with its heads; outputs the loss and its parts.

    Args:
        vla: its tower is trained in place.
        dense_shape: rows and columns of the dense targets; whole multiples of the vision tokens' grid.
    """

    def __init__(self, vla: LookTwiceVla, dense_shape: tuple[int, int]) -> None:
        super().__init__()
        self.vla = vla
        merge = vla.settings.spatial_merge_size
        self._rows, self._columns = (side // merge for side in vla.settings.grid[1:])
        self._cell = (dense_shape[0] // self._rows, dense_shape[1] // self._columns)
        text: Any = vla.config.text_config
        hidden = text.hidden_size
        cells = self._cell[0] * self._cell[1]
        self.dense_head = nn.Linear(hidden, cells * (_CLASSES + 1))
        # One head over everything seen, with places kept: where something stands is what counts.
        places = len(vla.settings.cameras) * self._rows * self._columns
        self.squeeze = nn.Linear(hidden, 24)
        self.fact_head = nn.Sequential(nn.Linear(places * 24, 256), nn.SiLU(), nn.Linear(256, len(FACTS)))

    def forward(
        self, patches: Tensor, classes: Tensor, range_log: Tensor, facts: Tensor
    ) -> dict[str, Tensor]:
        """The loss of a batch from `collate_grounding`, and its parts without gradients."""
        batch, cameras = classes.shape[:2]
        grid = torch.tensor([[1, *self.vla.settings.grid[1:]]] * (batch * cameras))
        tokens = self.vla.vision(patches, grid)
        dense = self.dense_head(tokens).float()
        dense = dense.view(batch, cameras, self._rows, self._columns, *self._cell, _CLASSES + 1)
        dense = dense.permute(0, 1, 2, 4, 3, 5, 6).reshape(*classes.shape, _CLASSES + 1)
        labels = classes.long()
        class_loss = F.cross_entropy(
            dense[..., :_CLASSES].flatten(0, -2), labels.flatten(), weight=dense.new_tensor(_CLASS_WEIGHTS)
        )
        shown = range_log > 0
        weight = torch.where(labels >= 3, _OBJECT_RANGE_WEIGHT, 1.0)[shown]
        error = (dense[..., _CLASSES] - range_log).abs()[shown]
        range_loss = (error * weight).sum() / weight.sum().clamp_min(1)
        of_facts = fact_loss(self.fact_head(self.squeeze(tokens).reshape(batch, -1)), facts)
        with torch.no_grad():
            objects = labels >= 3
            hit = (dense[..., :_CLASSES].argmax(-1) == labels)[objects].float().mean()
        return {
            "loss": class_loss + range_loss + of_facts,
            "class_loss": class_loss.detach(),
            "range_error_log": error.mean().detach(),
            "fact_loss": of_facts.detach(),
            "object_recall": hit.nan_to_num(0.0),
        }
