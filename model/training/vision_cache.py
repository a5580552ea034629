"""What a frozen tower sees in all examples, worked out once: an epoch then costs no tower.

The tokens lie in files of float16, one an episode, mapped into memory. A file's name tells tower, cameras
and pictures apart, so tokens of others are never taken. Scenes that are added cost what they add, and a
killed run goes on behind the last whole episode.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch
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
        parts: float16 [sides, n, v, hidden] each; the examples lie one part behind the other.
    """

    def __init__(self, parts: Sequence[Tokens]) -> None:
        self._parts = parts
        self._starts = np.cumsum([0, *(part.shape[1] for part in parts)])

    @property
    def mirrored(self) -> bool:
        """Whether mirror images are there too."""
        return len(self._parts[0]) > 1

    def tokens(self, index: int, mirror: bool) -> Tokens:
        """Of one example, [v, hidden]; raises IndexError for a mirror image that is not there."""
        part = int(np.searchsorted(self._starts, index, side="right")) - 1
        found: Tokens = self._parts[part][int(mirror), index - int(self._starts[part])]
        return found


def open_vision(
    loaded: Loaded,
    examples: Examples,
    folder: Path,
    *,
    mirrored: bool,
    bf16: bool = False,
    workers: int = 0,
    on_done: Callable[[int, int], None] | None = None,
) -> VisionCache:
    """The tokens that ``loaded``'s tower gives for examples; worked out where they are not there yet.

    Examples without pictures have none: their tokens are empty.

    Args:
        loaded: whose tower it is.
        examples: to look at.
        folder: where the files lie or go.
        mirrored: look at mirror images too.
        bf16: mixed precision, as the training has it.
        workers: processes that decode pictures; 0 decodes them in this one.
        on_done: told how many of how many episodes are done, whenever one is.
    """
    tower, pictured = _tower(loaded), examples.pictured
    changes = np.diff(examples.episode) | np.diff(pictured)
    ends = [*np.flatnonzero(changes) + 1, len(examples)]
    episodes = [range(start, end) for start, end in zip([0, *ends], ends, strict=False)]
    paths = {
        places: folder / f"vision-{_key(tower, examples, places, mirrored=mirrored)}.npy"
        for places in episodes
        if pictured[places.start]
    }
    missing = [places for places, path in paths.items() if not path.exists()]
    for places, seen in _look(loaded, examples, missing, mirrored, bf16, workers):
        with written_whole(paths[places]) as temporary, temporary.open("wb") as file:
            np.save(file, seen)
        if on_done is not None:
            on_done(episodes.index(places) + 1, len(episodes))
    return VisionCache(
        [
            np.load(paths[places], mmap_mode="r")
            if places in paths
            else np.zeros((1 + mirrored, len(places), 0, 0), np.float16)
            for places in episodes
        ]
    )


class _Pictures(Dataset[npt.NDArray[np.uint8]]):
    """The patches of examples, uint8 [sides, p, n]: as they are and, where asked for, mirrored."""

    def __init__(self, loaded: Loaded, examples: Examples, mirrored: bool) -> None:
        self._inputs, self._examples, self._mirrored = loaded.inputs, examples, mirrored

    def __getitem__(self, place: int) -> npt.NDArray[np.uint8]:
        frames = example_frames(self._examples, place, False, self._inputs)
        sides = [frames, frames[:, :, ::-1]][: 1 + self._mirrored]
        return np.stack([patchify(side, self._inputs.settings) for side in sides])


@torch.inference_mode()
def _look(
    loaded: Loaded, examples: Examples, episodes: Sequence[range], mirrored: bool, bf16: bool, workers: int
) -> Iterator[tuple[range, Tokens]]:
    """Tokens [sides, n, v, hidden] of one episode after the other."""
    settings, device = loaded.settings, loaded.model.device
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
        grid = torch.tensor([settings.grid] * (count * sides * len(settings.cameras)))
        with torch.autocast(device.type, torch.bfloat16, enabled=bf16):
            flat = torch.from_numpy(patches.reshape(-1, patches.shape[-1])).to(device)
            tokens = loaded.model.vision(flat, grid)
        tokens = tokens.view(count, sides, settings.vision_tokens, -1).transpose(0, 1)
        found.append(tokens.half().cpu().numpy())
        if batch.stop == places.stop:
            yield places, np.concatenate(found, axis=1)
            found.clear()


def _tower(loaded: Loaded) -> str:
    weights: dict[str, Any] = loaded.model.model.visual.state_dict()
    tower = [weights[name].float().cpu().numpy().tobytes() for name in sorted(weights)]
    return hash_of(loaded.settings.cameras, loaded.settings.grid, *tower)


def _key(tower: str, examples: Examples, places: range, *, mirrored: bool) -> str:
    # Not by the names of scenes: two folders may have scenes of one name, with other pictures.
    spans = examples.picture_spans[places.start : places.stop].reshape(-1, 2)
    pictures = hashlib.sha256()
    for first, last in spans.tolist():
        pictures.update((last - first).to_bytes(8, "big") + examples.pictures[first:last].data)
    return hash_of(_VERSION, mirrored, tower, pictures.digest())
