"""What a frozen tower sees in all examples, worked out once: an epoch then costs no tower.

The tokens lie in files of float16, one an episode, mapped into memory. A file's name tells tower, cameras
and pictures apart, so tokens of others are never taken. Scenes that are added cost what they add, and a
killed run goes on behind the last whole episode.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch

from model.driving.hashing import hash_of
from model.driving.whole_files import written_whole
from model.network.checkpoint import Loaded
from model.network.patches import patchify
from model.network.precision import bfloat16_is_fast
from model.training.examples import Examples, example_frames

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
    on_done: Callable[[int, int], None] | None = None,
) -> VisionCache:
    """The tokens that ``loaded``'s tower gives for examples; worked out where they are not there yet.

    Examples without pictures have none: their tokens are empty.

    Args:
        loaded: whose tower it is.
        examples: to look at.
        folder: where the files lie or go.
        mirrored: look at mirror images too.
        on_done: told how many of how many episodes are done, whenever one is.
    """
    tower, pictured = _tower(loaded), examples.pictured
    changes = np.diff(examples.episode) | np.diff(pictured)
    ends = [*np.flatnonzero(changes) + 1, len(examples)]
    episodes = [range(start, end) for start, end in zip([0, *ends], ends, strict=False)]
    parts: list[Tokens] = []
    for number, places in enumerate(episodes, start=1):
        if not pictured[places.start]:
            parts.append(np.zeros((1 + mirrored, len(places), 0, 0), np.float16))
            continue
        path = folder / f"vision-{_key(tower, examples, places, mirrored=mirrored)}.npy"
        if not path.exists():
            seen = [_look(loaded, examples, places, mirror) for mirror in (False, True)[: 1 + mirrored]]
            with written_whole(path) as temporary, temporary.open("wb") as file:
                np.save(file, np.stack(seen))
            if on_done is not None:
                on_done(number, len(episodes))
        parts.append(np.load(path, mmap_mode="r"))
    return VisionCache(parts)


@torch.inference_mode()
def _look(loaded: Loaded, examples: Examples, places: range, mirror: bool) -> Tokens:
    """Tokens [n, v, hidden] of examples, or of their mirror images."""
    settings, device = loaded.settings, loaded.model.device
    found = []
    for start in range(places.start, places.stop, _BATCH):
        batch = range(start, min(start + _BATCH, places.stop))
        patches = np.concatenate(
            [patchify(example_frames(examples, place, mirror, loaded.inputs), settings) for place in batch]
        )
        grid = torch.tensor([settings.grid] * (len(batch) * len(settings.cameras)))
        with torch.autocast(device.type, torch.bfloat16, enabled=bfloat16_is_fast(device.type)):
            tokens = loaded.model.vision(torch.from_numpy(patches).to(device), grid)
        found.append(tokens.view(len(batch), settings.vision_tokens, -1).half().cpu().numpy())
    return np.concatenate(found)


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
