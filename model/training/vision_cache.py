"""What a frozen tower sees in all examples, worked out once: an epoch then costs no tower.

The tokens lie in files of float16, one an episode, mapped into memory. A file's name tells tower, cameras,
precision and pictures apart, so tokens of others are never taken. Scenes that are added cost what they add,
and a killed run goes on behind the last whole episode.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from looktwice.model.driving.hashing import hash_of
from looktwice.model.driving.whole_files import written_whole
from looktwice.model.network.checkpoint import Loaded
from looktwice.model.network.patches import patchify
from looktwice.model.training.examples import Examples, example_frames

_BATCH: Final = 16
_VERSION: Final = 2

Tokens = npt.NDArray[np.float16]


class VisionCache:
    """Vision tokens of examples, and of their mirror images where they were asked for.

    Args:
        looks: of the tower and, where there are any, of the convolutions beside it: float16 [sides, n, v,
            hidden] each, the examples one part behind the other.
        cameras: of each example.
    """

    def __init__(self, looks: Sequence[Sequence[Tokens]], cameras: int) -> None:
        self._looks, self._cameras = looks, cameras
        self._starts = np.cumsum([0, *(part.shape[1] for part in looks[0])])

    @property
    def mirrored(self) -> bool:
        """Whether mirror images are there too."""
        return len(self._looks[0][0]) > 1

    def tokens(self, index: int, mirror: bool) -> Tokens:
        """Of one example, [v, hidden]; raises IndexError for a mirror image that is not there."""
        part = int(np.searchsorted(self._starts, index, side="right")) - 1
        place = index - int(self._starts[part])
        found: list[Tokens] = [parts[part][int(mirror), place] for parts in self._looks]
        if len(found) == 1 or not found[0].size:
            return found[0]
        # Of each camera the tower's tokens come first.
        of_cameras = [each.reshape(self._cameras, -1, each.shape[-1]) for each in found]
        joined: Tokens = np.concatenate(of_cameras, axis=1).reshape(-1, found[0].shape[-1])
        return joined


class _Look(NamedTuple):
    """What looks: a name of its weights and settings, and its tokens [k, hidden] of the patches of clips."""

    name: str
    tokens: Callable[[Tensor], Tensor]


def open_vision(
    loaded: Loaded,
    examples: Examples,
    folder: Path,
    *,
    mirrored: bool,
    fine: bool = True,
    bf16: bool = False,
    workers: int = 0,
    on_done: Callable[[int, int], None] | None = None,
) -> VisionCache:
    """The tokens that ``loaded``'s tower gives for examples; worked out where they are not there yet.

    Those of convolutions beside it lie in files of their own: where they learn on, the tower's stay.
    Examples without pictures have none: their tokens are empty.

    Args:
        loaded: whose tower it is.
        examples: to look at.
        folder: where the files lie or go.
        mirrored: look at mirror images too.
        fine: with the tokens of the convolutions beside the tower, where there are any.
        bf16: mixed precision, as the training has it.
        workers: processes that decode pictures; 0 decodes them in this one.
        on_done: told how many of how many files are there, whenever one is written.
    """
    pictured = examples.pictured
    changes = np.diff(examples.episode) | np.diff(pictured)
    ends = [*np.flatnonzero(changes) + 1, len(examples)]
    episodes = [range(start, end) for start, end in zip([0, *ends], ends, strict=False)]
    shown = {places: _digest(examples, places) for places in episodes if pictured[places.start]}
    looks = _looks(loaded, fine=fine)
    paths = [
        {
            places: folder / f"vision-{hash_of(_VERSION, mirrored, bf16, look.name, digest)}.npy"
            for places, digest in shown.items()
        }
        for look in looks
    ]
    missing = [[places for places, path in of_look.items() if not path.exists()] for of_look in paths]
    count = sum(map(len, paths))
    done = count - sum(map(len, missing))
    for look, of_look, lacking in zip(looks, paths, missing, strict=True):
        for places, tokens in _seen_by(look, loaded, examples, lacking, mirrored, bf16, workers):
            with written_whole(of_look[places]) as temporary, temporary.open("wb") as file:
                np.save(file, tokens)
            done += 1
            if on_done is not None:
                on_done(done, count)
    return VisionCache(
        [
            [
                np.load(of_look[places], mmap_mode="r")
                if places in of_look
                else np.zeros((1 + mirrored, len(places), 0, 0), np.float16)
                for places in episodes
            ]
            for of_look in paths
        ],
        len(loaded.settings.cameras),
    )


def _looks(loaded: Loaded, *, fine: bool) -> list[_Look]:
    model, settings = loaded.model, loaded.settings

    def of_tower(patches: Tensor) -> Tensor:
        clips = len(patches) // math.prod(settings.grid)
        return model.tower_tokens(patches, torch.tensor([settings.grid] * clips))

    looks = [_Look(_named(loaded, model.model.visual), of_tower)]
    if fine and (beside := model.fine_vision) is not None:
        looks.append(_Look(_named(loaded, beside), lambda patches: beside(patches).flatten(0, 1)))
    return looks


class _Pictures(Dataset[npt.NDArray[np.uint8]]):
    """The patches of examples, uint8 [sides, p, n]: as they are and, where asked for, mirrored."""

    def __init__(self, loaded: Loaded, examples: Examples, mirrored: bool) -> None:
        self._inputs, self._examples, self._mirrored = loaded.inputs, examples, mirrored

    def __getitem__(self, place: int) -> npt.NDArray[np.uint8]:
        frames = example_frames(self._examples, place, False, self._inputs)
        sides = [frames, frames[:, :, ::-1]][: 1 + self._mirrored]
        return np.stack([patchify(side, self._inputs.settings) for side in sides])


@torch.inference_mode()
def _seen_by(
    look: _Look,
    loaded: Loaded,
    examples: Examples,
    episodes: Sequence[range],
    mirrored: bool,
    bf16: bool,
    workers: int,
) -> Iterator[tuple[range, Tokens]]:
    """Tokens [sides, n, v, hidden] of one episode after the other."""
    device = loaded.model.device
    batches = [
        (places, range(start, min(start + _BATCH, places.stop)))
        for places in episodes
        for start in range(places.start, places.stop, _BATCH)
    ]
    loader = DataLoader(
        _Pictures(loaded, examples, mirrored),
        batch_sampler=[list(batch) for _, batch in batches],
        collate_fn=np.stack,
        num_workers=workers,
    )
    found: list[Tokens] = []
    for (places, batch), patches in zip(batches, loader, strict=True):
        count, sides = patches.shape[:2]
        with torch.autocast(device.type, torch.bfloat16, enabled=bf16):
            tokens = look.tokens(torch.from_numpy(patches.reshape(-1, patches.shape[-1])).to(device))
        tokens = tokens.view(count, sides, -1, tokens.shape[-1]).transpose(0, 1)
        found.append(tokens.half().cpu().numpy())
        if batch.stop == places.stop:
            yield places, np.concatenate(found, axis=1)
            found.clear()


def _named(loaded: Loaded, part: nn.Module) -> str:
    weights = part.state_dict()
    numbers = [weights[name].float().cpu().numpy().tobytes() for name in sorted(weights)]
    return hash_of(loaded.settings.cameras, loaded.settings.grid, *numbers)


def _digest(examples: Examples, places: range) -> bytes:
    """Tells the pictures of some examples apart from others."""
    # Not by the names of scenes: two folders may have scenes of one name, with other pictures.
    spans = examples.picture_spans[places.start : places.stop].reshape(-1, 2)
    pictures = hashlib.sha256()
    for first, last in spans.tolist():
        pictures.update((last - first).to_bytes(8, "big") + examples.pictures[first:last].data)
    return pictures.digest()
