"""Requests, and a decoder that works through them, its books checked after every step."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from model.engines.engine import Controls, Draw, DrawFinished, PlanRequest
from model.engines.torch.decoder import Decoder, Failed
from tests.checkpoints import noisy_scene


class Again:
    """Stands for a captured graph where there is no GPU: does the same with the same buffers."""

    def __init__(self, run: Callable[[], Tensor]) -> None:
        self._run = run
        self.output = run()

    def replay(self) -> None:
        self.output.copy_(self._run())


Draws = dict[tuple[str, int], Draw]


def request(name: str, scene: int = 0, format: str = "cf_vla", **controls: object) -> PlanRequest:
    return PlanRequest(name, noisy_scene(scene, route=scene % 2 == 1), format, Controls(**controls))  # type: ignore[arg-type]


def decode_some(decoder: Decoder, *requests: PlanRequest) -> tuple[Draws, dict[str, Exception]]:
    """What ended, and what failed."""
    for each in requests:
        decoder.add(each)
    draws: Draws = {}
    failed: dict[str, Exception] = {}
    while not decoder.idle:
        for name, event in decoder.step():
            if isinstance(event, DrawFinished):
                draws[name, event.draw.index] = event.draw
            elif isinstance(event, Failed):
                failed[name] = event.error
        decoder.check_integrity()
    return draws, failed


def decode(decoder: Decoder, *requests: PlanRequest) -> Draws:
    """What ended; nothing may fail."""
    draws, failed = decode_some(decoder, *requests)
    assert not failed, failed
    return draws
