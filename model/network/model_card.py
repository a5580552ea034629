"""What a loaded checkpoint is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class ModelCard:
    """What a loaded checkpoint is.

    Attributes:
        name: e.g. ``looktwice-nano``.
        revision: changes with the weights, the codec and the codes of pictures.
        engine: ``torch``, ``vllm`` or ``transformers``.
        formats: response formats it can write; the first is that of requests that name none.
        cameras: cameras it looks at; a scene must have these.
        image_size: width, height in pixels that pictures are resized to.
        parameters: how many weights.
        inputs: what it takes of a scene beside pictures and history: ``route``, ``tracks``.
        paints: whether it can paint the pictures that it imagines.
        deadlines: whether its engine keeps them.
        details: anything else worth showing, JSON-like.
    """

    name: str
    revision: str
    engine: str
    formats: tuple[str, ...]
    cameras: tuple[str, ...]
    image_size: tuple[int, int]
    parameters: int
    inputs: tuple[str, ...] = ("route",)
    paints: bool = False
    deadlines: bool = True
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def default_format(self) -> str:
        """The format of requests that name none: the first; empty where there is none."""
        return next(iter(self.formats), "")
