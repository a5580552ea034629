"""Vision tokens of scenes: each slice of pictures goes through the tower once while it is remembered."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from looktwice.model.driving.scene import Scene
from looktwice.model.engines.torch.clips import ClipCache, digest
from looktwice.model.engines.torch.picture_cache import Frames
from looktwice.model.network.checkpoint import Loaded


class Encoded(NamedTuple):
    """A scene's vision tokens [k, hidden], and what tells its pictures from others."""

    tokens: Tensor
    digest: bytes


class _Opened(NamedTuple):
    """A scene's slices by digest, the vision tokens that are cached, and the patches of the others."""

    keys: list[bytes]
    cached: dict[bytes, Tensor]
    patches: dict[bytes, npt.NDArray[np.uint8]]


class VisionEncoder:
    """Owns the vision tower and the cache of what it made.

    Args:
        loaded: the network.
        frames: where pictures are decoded.
        clip_bytes: of vision tokens cached.
        products: what matrix products are worked out in; None for the weights' own type.
        one_by_one: whether the tower sees one slice at a time, so that no sum depends on the others.
    """

    def __init__(
        self,
        loaded: Loaded,
        frames: Frames,
        *,
        clip_bytes: int,
        products: torch.dtype | None,
        one_by_one: bool,
    ) -> None:
        self._loaded, self._frames, self._one_by_one = loaded, frames, one_by_one
        self._clips = ClipCache(clip_bytes)
        model: Any = loaded.model
        parts = model.model.visual, model.fine_vision
        self._tower, self._fine_vision = (
            part if products is None or part is None else copy.deepcopy(part).to(products) for part in parts
        )

    def encode(self, scenes: Sequence[Scene]) -> list[Encoded | Exception]:
        """Encode the pictures of scenes together.

        A scene that cannot be made into inputs (a missing camera, a damaged picture) gets its exception.
        """
        opened = [self._open(scene) for scene in scenes]
        new: dict[bytes, npt.NDArray[np.uint8]] = {}
        for each in opened:
            if isinstance(each, _Opened):
                new |= each.patches
        made = self._tokens(new)
        encoded: list[Encoded | Exception] = []
        for each in opened:
            if isinstance(each, Exception):
                encoded.append(each)
                continue
            tokens = [each.cached[key] if key in each.cached else made[key] for key in each.keys]
            encoded.append(Encoded(torch.cat(tokens), b"".join(each.keys)))
        for key, tokens_of in made.items():
            # A copy: a part of a tensor would keep all of it.
            self._clips.keep(key, tokens_of.clone())
        return encoded

    def _open(self, scene: Scene) -> _Opened | Exception:
        """A scene's pictures: what is cached of them, and the patches of the others."""
        try:
            slices = self._loaded.inputs.slices(scene)
            keys = [digest(pictures) for pictures in slices]
            cached = {key: tokens for key in keys if (tokens := self._clips.get(key)) is not None}
            patches = {
                key: self._frames.patches(pictures)
                for key, pictures in zip(keys, slices, strict=True)
                if key not in cached
            }
        except Exception as error:  # one scene that cannot be read must not end the others
            return error
        return _Opened(keys, cached, patches)

    def _tokens(self, patches: Mapping[bytes, npt.NDArray[np.uint8]]) -> dict[bytes, Tensor]:
        """Vision tokens of slices, each [k, hidden]."""
        if not patches:
            return {}
        loaded, every = self._loaded, list(patches.values())
        at_once = 1 if self._one_by_one else len(every)
        grid = torch.tensor([[1, *loaded.settings.grid[1:]]] * at_once)
        tokens = [
            loaded.model.vision(
                torch.from_numpy(np.concatenate(every[first : first + at_once])).to(loaded.model.device),
                grid,
                self._tower,
                self._fine_vision,
            )
            for first in range(0, len(every), at_once)
        ]
        return dict(zip(patches, torch.cat(tokens).tensor_split(len(patches)), strict=True))
