"""Training of the composer of pictures: what to take from what was seen, and what to paint from codes.

The codes stay as they are, so models that write them need not learn anything anew. A model writes some codes
wrong, most of them as if nothing had changed. So the composer learns with any share of them spoilt in that
way, and from a checkpoint's own pictures where there is one. It learns how far to trust them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from looktwice.model.driving.images import encode_png, tiled
from looktwice.model.driving.next_view import expected_views
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.driving.whole_files import written_whole
from looktwice.model.families.picture_codes import LEVELS, levels_of
from looktwice.model.network.card import CARD_FILE, LOG_FILE
from looktwice.model.network.checkpoint import Loaded, load, save
from looktwice.model.network.composer import SEEN_PICTURES, Composer
from looktwice.model.network.visual_codes import (
    CODE_COLUMNS,
    CODE_ROWS,
    Frame,
    Seen,
    VisualCodes,
    batch_of,
    frame_of,
    load_visual_codes,
    psnr,
)
from looktwice.model.training.recipes import Recipe
from looktwice.model.training.trainer import inherit_log
from looktwice.model.training.visual_codes import SHEET_FILE, held_out, learn, painting_losses, spread
from looktwice.model.training.written_pictures import written_pictures

WRITTEN_FILE: Final = "written.jsonl"
"""What a checkpoint wrote, beside the log."""
_SHEET_PICTURES: Final = 6
_STEPPED_SHARE: Final = 0.25
"""The most levels that are spoilt by one up or down."""


@dataclass(frozen=True, eq=False)
class NextPair:
    """What a camera saw until now, and what it saw half a second later: encoded pictures.

    Attributes:
        episode, scene_id: that they are of.
        camera: one of `CAMERAS`.
        history: float32 [16, 4] of the ego.
        seen: half a second apart, the last one of now.
        came: half a second later.
        written: the 98 codes that a checkpoint writes of it, if it was asked.
    """

    episode: int
    scene_id: str
    camera: str
    history: FloatArray
    seen: tuple[bytes, ...]
    came: bytes
    written: tuple[int, ...] | None = None

    def frames(self) -> tuple[Seen, Frame]:
        """What was seen, moved as the ego moves on, and what came; takes some ms."""
        seen = expected_views(list(map(frame_of, self.seen)), self.camera, self.history)
        return seen, frame_of(self.came)


def pairs_of(scenes: Iterable[LabelledScene]) -> list[NextPair]:
    """The pairs of all cameras that scenes show now and half a second later."""
    pairs = []
    for labelled in scenes:
        came = {frame.camera: frame.image for frame in labelled.next_frames}
        for clip in labelled.scene.clips:
            if clip.camera in came:
                about = labelled.seed, labelled.scene.scene_id, clip.camera, labelled.scene.history
                pairs.append(NextPair(*about, clip.images[-SEEN_PICTURES:], came[clip.camera]))
    return pairs


class Example(NamedTuple):
    """A pair to learn from.

    Attributes:
        moved: uint8 [2, 112, 224, 3], what was seen, moved as the ego.
        came: uint8 [112, 224, 3].
        written: int64 [4, 7, 14], the levels that a checkpoint writes; -1 where none was asked.
    """

    moved: Seen
    came: Frame
    written: npt.NDArray[np.int64]


class PairDataset(Dataset[Example]):
    """Pairs to learn from; every second one, by chance, as a checkpoint writes it, where it wrote any.

    The others are mirrored or not, by chance: mirrored pictures have other codes, which nobody wrote.
    """

    def __init__(self, pairs: Sequence[NextPair], seed: int = 0) -> None:
        self._pairs = pairs
        self._written = [pair for pair in pairs if pair.written is not None]
        self.random = np.random.default_rng(seed)

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: int) -> Example:
        if self._written and self.random.random() < 0.5:
            pair = self._written[self.random.integers(len(self._written))]
            assert pair.written is not None
            levels = levels_of(pair.written).reshape(CODE_ROWS, CODE_COLUMNS, len(LEVELS))
            return Example(*pair.frames(), np.moveaxis(levels, -1, 0))
        moved, came = self._pairs[index].frames()
        unwritten = np.full((len(LEVELS), CODE_ROWS, CODE_COLUMNS), -1)
        if self.random.random() < 0.5:
            return Example(moved[:, :, ::-1], came[:, ::-1], unwritten)
        return Example(moved, came, unwritten)


def collate_pairs(examples: Sequence[Example]) -> dict[str, Tensor]:
    """Float32 batches: moved [b, 2, 3, 112, 224], came [b, 3, 112, 224], written [b, 4, 7, 14]."""
    moved = [batch_of(list(example.moved)) for example in examples]
    return {
        "moved": torch.stack(moved),
        "came": batch_of([example.came for example in examples]),
        "written": torch.from_numpy(np.stack([example.written for example in examples])).float(),
    }


class ComposerLearner(nn.Module):
    """The loss of composed pictures; the codes themselves do not learn."""

    def __init__(self, codes: VisualCodes) -> None:
        super().__init__()
        assert codes.composer is not None
        self.codes = codes
        for name, parameter in codes.named_parameters():
            parameter.requires_grad_(name.startswith("composer."))

    def forward(self, moved: Tensor, came: Tensor, written: Tensor) -> dict[str, Tensor]:
        """Losses of `painting_losses`; see `collate_pairs` for the arguments."""
        with torch.no_grad():
            levels, before = self.codes.levels(came), self.codes.levels(moved[:, -1])
            guessed = torch.where(written < 0, self._spoilt(levels, before), written)
        return painting_losses(self.codes.compose(guessed, moved, before), came)

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
    written_pairs: int = 4000,
    measured_pairs: int = 96,
    validate_every: int = 500,
    save_every: int = 250,
    bf16: bool = False,
    use_cpu: bool = True,
) -> dict[str, float]:
    """Train the composer of codes of pictures, which get one where they have none; returns the last figures.

    From a checkpoint that imagines it learns what that writes too, and the outcome is the checkpoint with
    its new composer. State is kept in ``target/state``, and what the checkpoint wrote in
    ``target/written.jsonl``: started again after a kill, it goes on from there.

    Args:
        recipe: how long and how fast.
        scenes: file or folder, with pictures half a second ahead.
        source: folder of the codes, or of a checkpoint that has some.
        target: folder to write: the codes with their composer or the checkpoint, a log, a sheet of pictures.
        validation: scenes whose pictures are held out; every tenth episode of ``scenes`` without them.
        written_pairs: pairs that a checkpoint is asked for.
        measured_pairs: held-out pairs that figures are told of.
        validate_every, save_every: steps.
        bf16: mixed precision; float32 is the faster one on CPUs.
        use_cpu: stay off accelerators.

    Raises:
        ValueError: no pairs to learn from, or none to hold out; a checkpoint that imagines nothing.
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
    measured = spread(others, measured_pairs)
    writer = load(source) if (source / CARD_FILE).is_file() else None
    stages: list[object] = []
    if writer is not None:
        target.mkdir(parents=True, exist_ok=True)
        inherit_log(target / LOG_FILE, [source])
        stages = list(writer.card.details.get("stages", []))
        asked = np.random.default_rng(recipe.seed).permutation(len(pairs))[:written_pairs]
        wanted = {(pair.scene_id, pair.camera) for pair in (*measured, *(pairs[place] for place in asked))}
        folders = (scenes,) if validation is None else (scenes, validation)
        shown = (labelled for folder in folders for labelled in read_scenes(folder, dense=False))
        written = written_pictures(writer, shown, wanted, target / WRITTEN_FILE)
        pairs, measured = (
            [replace(pair, written=written.get((pair.scene_id, pair.camera))) for pair in some]
            for some in (pairs, measured)
        )
    torch.manual_seed(recipe.seed)
    if codes.composer is None:
        codes.composer = Composer(len(LEVELS))
    about, figures = learn(
        ComposerLearner(codes),
        recipe if writer is None else replace(recipe, name=f"{len(stages) + 1} {recipe.name}"),
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
    if writer is not None:
        about["written_pairs"] = sum(pair.written is not None for pair in pairs)
    rows = [_row(codes, pair) for pair in spread(measured, _SHEET_PICTURES)]
    with written_whole(target / SHEET_FILE) as temporary:
        temporary.write_bytes(encode_png(tiled(rows)))
    before = codes.details.get("composer", [])
    assert isinstance(before, list)
    codes.details = {**codes.details, "composer": [*before, about | figures]}
    if writer is None:
        codes.save(target, codes.details)
    else:
        _save(target, writer, codes, [*stages, {"name": recipe.name, **about, **figures}])
    return figures


def _save(target: Path, writer: Loaded, codes: VisualCodes, stages: Sequence[object]) -> None:
    """Write a checkpoint with other codes of pictures."""
    save(
        target,
        writer.model,
        writer.vocabulary,
        writer.codec,
        dtype=torch.bfloat16,
        details={**writer.card.details, "stages": list(stages)},
        visual_codes=codes,
    )


def composed_figures(codes: VisualCodes, pairs: Sequence[NextPair]) -> dict[str, float]:
    """How near pictures come to what came half a second later; means over held-out pairs.

    Returns:
        ``moved_psnr_db``: what was seen, moved as the ego. ``painted_psnr_db``: the codes of what came,
        painted without it. ``composed_psnr_db``: the same codes with it. ``written_psnr_db``: the codes
        that a checkpoint wrote, with it, if it wrote those of all pairs.
    """
    was_training = codes.training
    codes.eval()
    found: dict[str, list[float]] = {}
    for pair in pairs:
        moved, came = pair.frames()
        right = codes.encode(came)
        pictures = {
            "moved_psnr_db": moved[-1],
            "painted_psnr_db": codes.decode(right),
            "composed_psnr_db": codes.decode(right, moved),
        }
        if pair.written is not None:
            pictures["written_psnr_db"] = codes.decode(pair.written, moved)
        for name, picture in pictures.items():
            found.setdefault(name, []).append(psnr(picture, came))
    codes.train(was_training)
    return {name: float(np.mean(each)) for name, each in found.items()} | {
        "measured_pairs": float(len(pairs))
    }


def _row(codes: VisualCodes, pair: NextPair) -> list[Frame]:
    """What was seen, moved; what came; what its codes are composed to, and those that were written."""
    moved, came = pair.frames()
    row = [moved[-1], came, codes.decode(codes.encode(came), moved)]
    return row if pair.written is None else [*row, codes.decode(pair.written, moved)]
