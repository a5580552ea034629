"""Requests, and a decoder that works through them, its books checked after every step."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from torch import Tensor

from looktwice.model.engines.engine import Controls, Draw, DrawFinished, PlanRequest
from looktwice.model.engines.least_error import LeastError
from looktwice.model.engines.torch.decoder import Decoder, Failed
from looktwice.model.engines.torch.request import Request, Tree
from looktwice.model.engines.torch.rows import Row
from looktwice.model.families.cf_vla import CF_VLA
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.network.checkpoint import Loaded
from tests.checkpoints import noisy_scene
from tests.model.engines.integrity import check_integrity


class Again:
    """Stands for a captured graph where there is no GPU: does the same with the same buffers."""

    def __init__(self, run: Callable[[], Tensor]) -> None:
        self._run = run
        self.result = run()

    def replay(self) -> None:
        self.result.copy_(self._run())


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
        check_integrity(decoder)
    return draws, failed


def decode(decoder: Decoder, *requests: PlanRequest) -> Draws:
    """What ended; nothing may fail."""
    draws, failed = decode_some(decoder, *requests)
    assert not failed, failed
    return draws


def beginning(loaded: Loaded, **controls: Any) -> Row:
    """A row in front of its first decision."""
    start = CompiledFormat(CF_VLA.format, loaded.vocabulary).start()
    asked = PlanRequest("a", noisy_scene(), "cf_vla", Controls(n=1, **controls))
    prompt: Any = SimpleNamespace(shown=b"pictures", last_token=0)
    row = Row(
        start,
        Tree(Request(asked, CF_VLA, start, 0.0, LeastError(loaded.codec, loaded.vocabulary)), prompt=prompt),
        (0,),
    )
    row.start(0)
    row.write(None, loaded.vocabulary)
    return row
