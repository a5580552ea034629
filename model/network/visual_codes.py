"""Pictures as codes: 98 numbers of 0 to 999 for a camera's picture of 224 x 112 pixels.

An encoder of small convolutions writes four numbers for each patch of 16 x 16 pixels. Finite scalar
quantisation (https://arxiv.org/abs/2309.15505) rounds them to 8, 5, 5 and 5 levels, which together are one
code. There is no codebook to learn or to collapse. A decoder paints the picture again. It has no adversary to
please, so that pictures are soft where the codes do not say enough. Where it is known what the camera saw
before, a `Composer` takes from that what did not change.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from looktwice.model.driving.images import decode_image
from looktwice.model.driving.whole_files import written_whole
from looktwice.model.families.picture_codes import (
    LEVELS,
    PICTURE_CODES,
    IntArray,
    VisualCodesError,
    codes_of,
    levels_of,
)
from looktwice.model.network.composer import SEEN_PICTURES, Composer
from looktwice.model.network.convolutions import ConvBlock

FRAME_WIDTH: Final = 224
FRAME_HEIGHT: Final = 112
CODE_ROWS, CODE_COLUMNS = FRAME_HEIGHT // 16, FRAME_WIDTH // 16
WEIGHTS_FILE: Final = "visual_codes.safetensors"
_VERSION: Final = 3
_INSIDE: Final = 1e-3
"""Keeps the outermost levels reachable: tanh itself reaches its bounds nowhere."""

Frame = npt.NDArray[np.uint8]
"""A picture uint8 [112, 224, 3]."""
Seen = npt.NDArray[np.uint8]
"""What a camera saw, moved as the ego: uint8 [2, 112, 224, 3], half a second apart, the last one of now."""


def frame_of(encoded: bytes) -> Frame:
    """An encoded picture as uint8 RGB [112, 224, 3]; raises `ImageError` for one that is not acceptable."""
    picture = decode_image(encoded)
    size = (FRAME_WIDTH, FRAME_HEIGHT)
    if picture.shape[1::-1] == size:
        return picture
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX), np.uint8)


def bounded(free: Tensor) -> Tensor:
    """Numbers [..., 4] squeezed to where their levels lie: 0 to one less than there are."""
    most = torch.tensor(LEVELS, dtype=free.dtype, device=free.device) - 1
    return most / 2 * (1 + (1 + _INSIDE) * torch.tanh(free))


def quantised(free: Tensor) -> Tensor:
    """The levels of numbers [..., 4], as floats; gradients pass as if nothing had been rounded."""
    squeezed = bounded(free)
    return squeezed + (squeezed.round() - squeezed).detach()


class VisualCodes(nn.Module):
    """The tokenizer of pictures: `encode` and `decode` for use, `forward` for training.

    Args:
        width: channels in the middle; half as many at twice the resolution.
        composes: whether it has a composer.

    Attributes:
        details: how it was made, as its file tells.
        composer: of pictures half a second later.
    """

    def __init__(self, width: int = 192, *, composes: bool = False) -> None:
        super().__init__()
        self.details: dict[str, object] = {}
        self.composer = Composer(len(LEVELS)) if composes else None
        half, fine = width // 2, width // 6
        self.width = width
        self.encoder = nn.Sequential(
            nn.PixelUnshuffle(8),
            nn.Conv2d(3 * 64, half, 1),
            ConvBlock(half),
            nn.Conv2d(half, width, 2, stride=2),
            ConvBlock(width),
            ConvBlock(width),
        )
        self.settled = nn.LayerNorm(width)
        self.exit = nn.Linear(width, len(LEVELS))
        # Numbers that already differ by whole levels: otherwise all patches have one code for long.
        nn.init.normal_(self.exit.weight, std=width**-0.5)
        self.entry = nn.Conv2d(len(LEVELS), width, 3, padding=1)
        self.place = nn.Parameter(torch.zeros(1, width, CODE_ROWS, CODE_COLUMNS))
        """What is usually where: the sky above, the bonnet below."""
        self.decoder = nn.Sequential(
            *(ConvBlock(width) for _ in range(4)),
            nn.Conv2d(width, 4 * half, 1),
            nn.PixelShuffle(2),
            ConvBlock(half),
            ConvBlock(half),
            nn.Conv2d(half, 4 * fine, 3, padding=1),
            nn.PixelShuffle(2),
            ConvBlock(fine),
            nn.Conv2d(fine, 3 * 16, 3, padding=1),
            nn.PixelShuffle(4),
        )

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """Pictures float [b, 3, 112, 224] in 0..1 painted again, and their levels [b, 4, 7, 14]."""
        levels = quantised(self.free(pictures)).movedim(-1, 1)
        return self.paint(levels), levels

    def free(self, pictures: Tensor) -> Tensor:
        """What stands before quantisation [b, 7, 14, 4], for pictures float [b, 3, 112, 224] in 0..1."""
        free: Tensor = self.exit(self.settled(self.encoder(pictures - 0.5).movedim(1, -1)))
        return free

    def levels(self, pictures: Tensor) -> Tensor:
        """The levels [b, 4, 7, 14] of pictures float [b, 3, 112, 224] in 0..1; without gradients."""
        return bounded(self.free(pictures)).round().movedim(-1, 1)

    def paint(self, levels: Tensor) -> Tensor:
        """The pictures [b, 3, 112, 224] of levels [b, 4, 7, 14]; about 0..1, not clipped."""
        painted: Tensor = self.decoder(self.entry(_scaled(levels)) + self.place) + 0.5
        return painted

    def compose(self, levels: Tensor, moved: Tensor, before: Tensor) -> Tensor:
        """The same, with what was seen before; for those that have a composer.

        Args:
            levels: [b, 4, 7, 14].
            moved: [b, 2, 3, 112, 224] in 0..1, as the camera would see it if only the ego had moved since.
            before: [b, 4, 7, 14], the levels of the last of ``moved``.
        """
        assert self.composer is not None, "these codes compose no pictures"
        composed: Tensor = self.composer(self.paint(levels), moved, _scaled(levels), _scaled(before))
        return composed

    @torch.inference_mode()
    def encode(self, frame: Frame) -> IntArray:
        """The codes int64 [98] of a picture uint8 [112, 224, 3].

        Pictures are encoded one by one, so that a picture's codes do not depend on its company.

        Raises:
            VisualCodesError: a picture of another size or type; see `frame_of`.
        """
        [levels] = self.levels(_checked(frame).to(self.place.device))
        return codes_of(levels.movedim(0, -1).to(torch.int64).cpu().numpy()).ravel()

    @torch.inference_mode()
    def decode(self, codes: npt.ArrayLike, moved: Seen | None = None) -> Frame:
        """The picture uint8 [112, 224, 3] of codes [98].

        Args:
            codes: of the picture.
            moved: what the camera saw before, see `looktwice.model.driving.next_view`. Codes without a
                composer paint without it.

        Raises:
            VisualCodesError: other codes, or a picture of another size or type.
        """
        numbers = np.asarray(codes)
        if numbers.shape != (PICTURE_CODES,):
            raise VisualCodesError(f"a picture has {PICTURE_CODES} codes, got {list(numbers.shape)}")
        grid = levels_of(numbers).reshape(CODE_ROWS, CODE_COLUMNS, len(LEVELS))
        levels = torch.from_numpy(grid).movedim(-1, 0)[None].to(self.place)
        if self.composer is None or moved is None:
            painted = self.paint(levels)
        else:
            if len(moved) != SEEN_PICTURES:
                raise VisualCodesError(f"a composer is shown {SEEN_PICTURES} pictures, got {len(moved)}")
            pictures = torch.cat(list(map(_checked, moved))).to(self.place.device)
            painted = self.compose(levels, pictures[None], self.levels(pictures[-1:]))
        return (painted[0].clamp(0, 1) * 255).round().to(torch.uint8).movedim(0, -1).cpu().numpy()

    def save(self, folder: Path, details: Mapping[str, object]) -> None:
        """Write ``visual_codes.safetensors`` into ``folder``; ``details`` tell how it was made."""
        about = {
            "version": _VERSION,
            "width": self.width,
            "levels": LEVELS,
            "composes": self.composer is not None,
            "details": dict(details),
        }
        state = {name: value.contiguous() for name, value in self.state_dict().items()}
        with written_whole(folder / WEIGHTS_FILE) as temporary:
            save_file(state, temporary, metadata={"looktwice": json.dumps(about)})


def load_visual_codes(folder: Path) -> VisualCodes:
    """Read what `VisualCodes.save` wrote; raises `VisualCodesError`."""
    path = folder / WEIGHTS_FILE
    if not path.is_file():
        raise VisualCodesError(f"{folder} has no {WEIGHTS_FILE}: `looktwice train visual-codes` makes one")
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads((file.metadata() or {}).get("looktwice", "{}"))
        if about.get("version") != _VERSION or tuple(about.get("levels", ())) != LEVELS:
            raise VisualCodesError(
                f"{path} has version {about.get('version')} and levels {about.get('levels')}; "
                f"this LookTwice reads {_VERSION} with {list(LEVELS)}"
            )
        codes = VisualCodes(about["width"], composes=about["composes"])
        codes.details = dict(about["details"])
        codes.load_state_dict(load_file(path))
    except (SafetensorError, json.JSONDecodeError, KeyError, RuntimeError) as error:
        raise VisualCodesError(f"{path} is damaged: {error}") from error
    return codes.eval()


def batch_of(frames: list[Frame]) -> Tensor:
    """Pictures uint8 [112, 224, 3] as float32 [b, 3, 112, 224] in 0..1."""
    return torch.from_numpy(np.stack(frames)).movedim(-1, 1).float() / 255


def _scaled(levels: Tensor) -> Tensor:
    """Levels [b, 4, 7, 14] in -1..1."""
    most = torch.tensor(LEVELS, dtype=levels.dtype, device=levels.device) - 1
    return 2 * levels / most[:, None, None] - 1


def _checked(frame: Frame) -> Tensor:
    """A picture as a batch; raises `VisualCodesError`."""
    if frame.shape != (FRAME_HEIGHT, FRAME_WIDTH, 3) or frame.dtype != np.uint8:
        shape = [FRAME_HEIGHT, FRAME_WIDTH, 3]
        raise VisualCodesError(f"a picture must be uint8 {shape}, got {frame.dtype} {list(frame.shape)}")
    return batch_of([frame])


def psnr(picture: Frame, other: Frame) -> float:
    """Peak signal-to-noise ratio in dB of two pictures; at most that of half a grey level everywhere."""
    error = float(((picture.astype(np.float64) - other) ** 2).mean())
    return 10 * math.log10(255**2 / max(error, 0.25))
