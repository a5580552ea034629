"""Training of the codes of pictures: on all cameras' frames, resumable after a kill as the recipes are."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor, nn
from torch.utils.data import Dataset

from looktwice.model.driving.images import encode_png, tiled
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.whole_files import written_whole
from looktwice.model.families.picture_codes import PICTURE_CODEBOOK
from looktwice.model.network.visual_codes import (
    CODE_COLUMNS,
    CODE_ROWS,
    FRAME_HEIGHT,
    FRAME_WIDTH,
    Frame,
    VisualCodes,
    batch_of,
    frame_of,
    psnr,
)
from looktwice.model.training.recipes import Recipe
from looktwice.model.training.run import last_whole_state
from looktwice.model.training.trainer import LearnerTrainer

SHEET_FILE: Final = "pictures.png"
_HELD_OUT_EVERY: Final = 10
"""Of the episodes, where no scenes are given for validation."""
_GRADIENT_WEIGHT: Final = 0.25
_SHEET_COLUMNS: Final = 4
_SHEET_PICTURES: Final = 8


class _OfEpisode(Protocol):
    @property
    def episode(self) -> int: ...


_Filmed = TypeVar("_Filmed", bound=_OfEpisode)


@dataclass(frozen=True)
class FilmedClip:
    """The encoded pictures of one clip, oldest first, and the episode that they are of."""

    episode: int
    images: tuple[bytes, ...]


def clips_of(scenes: Iterable[LabelledScene]) -> list[FilmedClip]:
    """The clips of all cameras."""
    return [FilmedClip(labelled.seed, clip.images) for labelled in scenes for clip in labelled.scene.clips]


def held_out(clips: Sequence[_Filmed]) -> tuple[list[_Filmed], list[_Filmed]]:
    """Clips to learn from, and those of every tenth episode; raises ValueError for a single episode."""
    episodes = sorted({clip.episode for clip in clips})
    if len(episodes) < 2:
        raise ValueError("pictures of one episode alone: give more scenes, or others with --validation")
    kept = set(episodes[::_HELD_OUT_EVERY])
    return [clip for clip in clips if clip.episode not in kept], [
        clip for clip in clips if clip.episode in kept
    ]


class FrameDataset(Dataset[Frame]):
    """Each clip as one of its frames, as it is or mirrored, by chance."""

    def __init__(self, clips: Sequence[FilmedClip], seed: int = 0) -> None:
        self._clips = clips
        self.random = np.random.default_rng(seed)

    def __len__(self) -> int:
        return len(self._clips)

    def __getitem__(self, index: int) -> Frame:
        images = self._clips[index].images
        frame = frame_of(images[self.random.integers(len(images))])
        return np.ascontiguousarray(frame[:, ::-1]) if self.random.random() < 0.5 else frame


class VisualCodesLearner(nn.Module):
    """The loss of pictures that went through their codes."""

    def __init__(self, codes: VisualCodes) -> None:
        super().__init__()
        self.codes = codes

    def forward(self, pictures: Tensor) -> dict[str, Tensor]:
        """Losses of `painting_losses`, of float pictures [b, 3, 112, 224] in 0..1."""
        painted, _ = self.codes(pictures)
        return painting_losses(painted, pictures)


def painting_losses(painted: Tensor, pictures: Tensor) -> dict[str, Tensor]:
    """Loss of painted pictures [b, 3, h, w] against real ones: absolute errors, of colours and of edges."""
    colours = F.l1_loss(painted, pictures)
    edges = sum(
        (F.l1_loss(painted.diff(dim=side), pictures.diff(dim=side)) for side in (2, 3)),
        torch.zeros((), device=pictures.device),
    )
    return {"loss": colours + _GRADIENT_WEIGHT * edges, "colour_loss": colours, "edge_loss": edges}


def train_visual_codes(
    recipe: Recipe,
    scenes: Path,
    target: Path,
    validation: Path | None = None,
    *,
    width: int | None = None,
    measured_clips: int = 48,
    validate_every: int = 500,
    save_every: int = 250,
    bf16: bool = False,
    use_cpu: bool = True,
) -> dict[str, float]:
    """Train codes of pictures and write them, a log and a sheet of pictures; returns the last figures.

    State is kept in ``target/state``: started again after a kill, it goes on from there.

    Args:
        recipe: how long and how fast.
        scenes: file or folder; pictures of all cameras are learned.
        target: folder to write.
        validation: scenes whose pictures are held out; every tenth episode of ``scenes`` without them.
        width: of `VisualCodes`; its own without one.
        measured_clips: held-out clips that figures are told of.
        validate_every, save_every: steps.
        bf16: mixed precision; float32 is the faster one on CPUs.
        use_cpu: stay off accelerators.

    Raises:
        ValueError: no clips to learn from, or none to hold out.
    """
    clips = clips_of(read_scenes(scenes, dense=False))
    if validation is None:
        clips, others = held_out(clips)
    else:
        others = clips_of(read_scenes(validation, dense=False))
    if not clips or not others:
        raise ValueError("there are no pictures to learn from, or none to hold out")
    torch.manual_seed(recipe.seed)
    codes = VisualCodes() if width is None else VisualCodes(width)
    measured = spread(others, measured_clips)
    about, figures = learn(
        VisualCodesLearner(codes),
        recipe,
        FrameDataset(clips, recipe.seed),
        lambda frames: {"pictures": batch_of(frames)},
        target,
        partial(picture_figures, codes, measured),
        validate_every=validate_every,
        save_every=save_every,
        bf16=bf16,
        use_cpu=use_cpu,
    )
    about |= {"clips": len(clips), "episodes": len({clip.episode for clip in clips})}
    contact_sheet(codes, [clip.images[-1] for clip in spread(measured, _SHEET_PICTURES)], target / SHEET_FILE)
    codes.save(target, about | figures)
    return figures


def learn(
    learner: nn.Module,
    recipe: Recipe,
    dataset: Dataset[Any],
    collate: Callable[[list[Any]], dict[str, Tensor]],
    target: Path,
    figures: Callable[[], dict[str, float]],
    *,
    validate_every: int,
    save_every: int,
    bf16: bool,
    use_cpu: bool,
) -> tuple[dict[str, object], dict[str, float]]:
    """Train codes of pictures, or a part of them; see `train_visual_codes` for the arguments.

    Returns:
        What the recipe was, and the last figures. The learner is in evaluation mode, on the CPU.
    """
    trainer = LearnerTrainer(
        learner,
        recipe,
        recipe.name,
        dataset,
        collate,
        target,
        sampler=None,
        validate=figures,
        validate_every=validate_every,
        save_every=save_every,
        bf16=bf16,
        use_cpu=use_cpu,
        workers=0,
    )
    trainer.train(resume_from_checkpoint=last_whole_state(target / "state"))
    learner.eval().cpu()
    about: dict[str, object] = {
        "steps": recipe.steps,
        "batch_size": recipe.batch_size,
        "learning_rate": recipe.learning_rate,
        "seed": recipe.seed,
    }
    return about, figures()


def spread(clips: Sequence[_Filmed], count: int) -> list[_Filmed]:
    """At most ``count`` clips, evenly out of all."""
    places = np.linspace(0, len(clips) - 1, min(count, len(clips))).round().astype(int)
    return [clips[place] for place in places]


def picture_figures(codes: VisualCodes, clips: Sequence[FilmedClip]) -> dict[str, float]:
    """What codes keep of held-out pictures.

    Returns:
        ``psnr_db``: mean over pictures. ``patch_psnr_db``: of each patch's mean colour, not rounded and
        smoothly joined, which says what 98 numbers out of 16.8 million would keep without learning.
        ``codes_used``: share of all codes. ``codes_kept``: share that is the same half a second later.
    """
    was_training = codes.training
    codes.eval()
    psnr_db, patch_db, kept = [], [], []
    used: set[int] = set()
    for clip in clips:
        written = []
        for image in clip.images:
            frame = frame_of(image)
            written.append(codes.encode(frame))
            psnr_db.append(psnr(frame, codes.decode(written[-1])))
            patch_db.append(psnr(frame, patch_means(frame)))
        used.update(np.unique(written).tolist())
        kept.append(np.mean(np.diff(written, axis=0) == 0))
    codes.train(was_training)
    return {
        "psnr_db": float(np.mean(psnr_db)),
        "patch_psnr_db": float(np.mean(patch_db)),
        "codes_used": len(used) / PICTURE_CODEBOOK,
        "codes_kept": float(np.mean(kept)),
        "pictures": float(len(psnr_db)),
    }


def patch_means(frame: Frame) -> Frame:
    """A picture of the mean colours of its patches of 16 x 16 pixels, joined smoothly."""
    small = Image.fromarray(frame).resize((CODE_COLUMNS, CODE_ROWS), Image.Resampling.BOX)
    return np.asarray(small.resize((FRAME_WIDTH, FRAME_HEIGHT), Image.Resampling.BICUBIC), np.uint8)


def contact_sheet(codes: VisualCodes, images: Sequence[bytes], path: Path) -> None:
    """Write a PNG of encoded pictures, each above what its codes are painted as."""
    frames = list(map(frame_of, images))
    rows = []
    for start in range(0, len(frames), _SHEET_COLUMNS):
        row = frames[start : start + _SHEET_COLUMNS]
        rows += [row, [codes.decode(codes.encode(frame)) for frame in row]]
    with written_whole(path) as temporary:
        temporary.write_bytes(encode_png(tiled(rows)))
