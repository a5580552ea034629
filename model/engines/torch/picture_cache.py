"""Pictures in the network's size, decoded beside the engine's thread and kept for a while."""

from __future__ import annotations

import threading
from contextlib import suppress
from hashlib import blake2b
from typing import Final

import numpy as np
import numpy.typing as npt
from cachetools import LRUCache

from looktwice.model.driving.scene import Scene, SceneError
from looktwice.model.network.inputs import InputBuilder

MAX_BYTES: Final = 64 << 20

Frame = npt.NDArray[np.uint8]


class Frames:
    """Decodes each picture once; a planner's next request shows most of them again. For several threads.

    A full-HD scene takes longer to decode than to plan for: on the engine's thread that would hold up
    everybody, and deadlines could not foresee it.

    Args:
        inputs: of the checkpoint.
        max_bytes: of frames kept, the least recently used forgotten first.
    """

    def __init__(self, inputs: InputBuilder, max_bytes: int = MAX_BYTES) -> None:
        self._inputs = inputs
        self._kept: LRUCache[bytes, Frame] = LRUCache(max_bytes, getsizeof=lambda frame: frame.nbytes)
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._kept)

    def look_at(self, scene: Scene) -> None:
        """Decode a scene's pictures ahead; raises `ImageError` where one is damaged.

        A camera that is missing is told by who asks for its patches.
        """
        with suppress(SceneError):
            for pictures in self._inputs.slices(scene):
                for picture in pictures:
                    self._frame(picture)

    def patches(self, pictures: tuple[bytes, ...]) -> npt.NDArray[np.uint8]:
        """See `InputBuilder.patches`."""
        return self._inputs.patchified([self._frame(picture) for picture in pictures])

    def _frame(self, picture: bytes) -> Frame:
        key = blake2b(picture, digest_size=16).digest()
        with self._lock:
            if (kept := self._kept.get(key)) is not None:
                return kept
        frame = self._inputs.frame(picture)
        with self._lock, suppress(ValueError):  # larger than all that is kept
            self._kept[key] = frame
        return frame
