"""Training of the composer of pictures: what to take from half a second before, and what to paint from codes.

The codes stay as they are, so models that write them need not learn anything anew. A model writes some codes
wrong, most of them as if nothing had changed. So the composer learns with any share of them spoilt in that
way, and learns how far to trust them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from looktwice.model.driving.images import encode_png, tiled
from looktwice.model.driving.next_view import expected_view
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.driving.whole_files import written_whole
from looktwice.model.families.picture_codes import LEVELS
from looktwice.model.network.composer import Composer
from looktwice.model.network.visual_codes import (
    Frame,
    VisualCodes,
    batch_of,
    frame_of,
    load_visual_codes,
    psnr,
)
from looktwice.model.training.recipes import Recipe
from looktwice.model.training.visual_codes import SHEET_FILE, held_out, learn, painting_losses, spread

_SHEET_PICTURES: Final = 6
_STEPPED_SHARE: Final = 0.25
"""The most levels that are spoilt by one up or down."""


@dataclass(frozen=True, eq=False)
class NextPair:
    """What a camera saw, and what it saw half a second later: encoded pictures.

    Attributes:
        episode: that they are of.
        camera: one of `CAMERAS`.
        history: float32 [16, 4] of the ego, up to the first.
        seen, came: the two.
    """

    episode: int
    camera: str
    history: FloatArray
    seen: bytes
    came: bytes

    def frames(self) -> tuple[Frame, Frame]:
        """The first, moved as the ego moves on, and the second; takes some ms."""
        return expected_view(frame_of(self.seen), self.camera, self.history), frame_of(self.came)


def pairs_of(scenes: Iterable[LabelledScene]) -> list[NextPair]:
    """The pairs of all cameras that scenes show now and half a second later."""
    pairs = []
    for labelled in scenes:
        came = {frame.camera: frame.image for frame in labelled.next_frames}
        for clip in labelled.scene.clips:
            if clip.camera in came:
                about = labelled.seed, clip.camera, labelled.scene.history
                pairs.append(NextPair(*about, clip.images[-1], came[clip.camera]))
    return pairs


class PairDataset(Dataset[tuple[Frame, Frame]]):
    """Each pair's frames, as they are or mirrored, by chance."""

    def __init__(self, pairs: Sequence[NextPair], seed: int = 0) -> None:
        self._pairs = pairs
        self.random = np.random.default_rng(seed)

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: int) -> tuple[Frame, Frame]:
        moved, came = self._pairs[index].frames()
        if self.random.random() < 0.5:
            return np.ascontiguousarray(moved[:, ::-1]), np.ascontiguousarray(came[:, ::-1])
        return moved, came


def collate_pairs(pairs: Sequence[tuple[Frame, Frame]]) -> dict[str, Tensor]:
    """Pairs as two batches float32 [b, 3, 112, 224]."""
    return {
        "moved": batch_of([moved for moved, _ in pairs]),
        "came": batch_of([came for _, came in pairs]),
    }


class ComposerLearner(nn.Module):
    """The loss of composed pictures; the codes themselves do not learn."""

    def __init__(self, codes: VisualCodes) -> None:
        super().__init__()
        assert codes.composer is not None
        self.codes = codes
        for name, parameter in codes.named_parameters():
            parameter.requires_grad_(name.startswith("composer."))

    def forward(self, moved: Tensor, came: Tensor) -> dict[str, Tensor]:
        """Losses of `painting_losses`, of pictures float [b, 3, 112, 224] in 0..1."""
        with torch.no_grad():
            levels, before = self.codes.levels(came), self.codes.levels(moved)
            spoilt = self._spoilt(levels, before)
        return painting_losses(self.codes.compose(spoilt, moved, before), came)

    @staticmethod
    def _spoilt(levels: Tensor, before: Tensor) -> Tensor:
        """Levels [b, 4, 7, 14] with mistakes as models make them, more in some pictures than in others."""
        each = levels.new_empty(len(levels), 1, 1, 1)
        unchanged = torch.rand_like(levels) < each.uniform_()
        mixed = torch.where(unchanged, before, levels)
        stepped = torch.rand_like(levels) < _STEPPED_SHARE * each.uniform_()
        most = torch.tensor(LEVELS, dtype=levels.dtype, device=levels.device)[:, None, None] - 1
        return torch.minimum((mixed + stepped * torch.randint_like(levels, -1, 2)).clamp(min=0), most)


def train_composer(
    recipe: Recipe,
    scenes: Path,
    source: Path,
    target: Path,
    validation: Path | None = None,
    *,
    measured_pairs: int = 96,
    validate_every: int = 500,
    save_every: int = 250,
    bf16: bool = False,
    use_cpu: bool = True,
) -> dict[str, float]:
    """Train the composer of codes of pictures, which get one where they have none; returns the last figures.

    State is kept in ``target/state``: started again after a kill, it goes on from there.

    Args:
        recipe: how long and how fast.
        scenes: file or folder, with pictures half a second ahead.
        source: folder of the codes.
        target: folder to write: the codes with their composer, a log, and a sheet of pictures.
        validation: scenes whose pictures are held out; every tenth episode of ``scenes`` without them.
        measured_pairs: held-out pairs that figures are told of.
        validate_every, save_every: steps.
        bf16: mixed precision; float32 is the faster one on CPUs.
        use_cpu: stay off accelerators.

    Raises:
        ValueError: no pairs to learn from, or none to hold out.
        VisualCodesError: there are no codes in ``source``.
    """
    codes = load_visual_codes(source)
    pairs = pairs_of(read_scenes(scenes, dense=False))
    if validation is None:
        pairs, others = held_out(pairs)
    else:
        others = pairs_of(read_scenes(validation, dense=False))
    if not pairs or not others:
        raise ValueError(
            "there are no pictures half a second ahead: `looktwice scenes generate --next-frames`"
        )
    torch.manual_seed(recipe.seed)
    if codes.composer is None:
        codes.composer = Composer(len(LEVELS))
    measured = spread(others, measured_pairs)
    about, figures = learn(
        ComposerLearner(codes),
        recipe,
        PairDataset(pairs, recipe.seed),
        collate_pairs,
        target,
        partial(composed_figures, codes, measured),
        validate_every=validate_every,
        save_every=save_every,
        bf16=bf16,
        use_cpu=use_cpu,
    )
    about |= {"pairs": len(pairs), "episodes": len({pair.episode for pair in pairs})}
    rows = [[*pair.frames(), _composed(codes, *pair.frames())] for pair in spread(measured, _SHEET_PICTURES)]
    with written_whole(target / SHEET_FILE) as temporary:
        temporary.write_bytes(encode_png(tiled(rows)))
    before = codes.details.get("composer", [])
    assert isinstance(before, list)
    codes.save(target, {**codes.details, "composer": [*before, about | figures]})
    return figures


def composed_figures(codes: VisualCodes, pairs: Sequence[NextPair]) -> dict[str, float]:
    """How near pictures come to what came half a second later; means over held-out pairs.

    Returns:
        ``moved_psnr_db``: what was seen, moved as the ego. ``painted_psnr_db``: the codes of what came,
        painted without it. ``composed_psnr_db``: the same codes with it.
    """
    was_training = codes.training
    codes.eval()
    found = []
    for pair in pairs:
        moved, came = pair.frames()
        painted = codes.decode(codes.encode(came))
        found.append([psnr(each, came) for each in (moved, painted, _composed(codes, moved, came))])
    codes.train(was_training)
    names = ("moved_psnr_db", "painted_psnr_db", "composed_psnr_db")
    return dict(zip(names, np.mean(found, axis=0).tolist(), strict=True)) | {
        "measured_pairs": float(len(found))
    }


def _composed(codes: VisualCodes, moved: Frame, came: Frame) -> Frame:
    return codes.decode(codes.encode(came), moved)
