"""Requests that are all there from the beginning, answered without a service."""

from __future__ import annotations

from collections.abc import Iterable

from looktwice.model.engines.engine import Draw, DrawFinished, PlanRequest
from looktwice.model.engines.torch.decoder import Decoder, Failed
from looktwice.model.engines.torch.runner import Runner


def draws_of(runner: Runner, requests: Iterable[PlanRequest]) -> dict[str, list[Draw]]:
    """The draws of each request, by its id, in order. Call under `torch.inference_mode`.

    Raises:
        Exception: what a request failed of.
    """
    decoder = Decoder(runner)
    draws: dict[str, list[Draw]] = {}
    for request in requests:
        decoder.add(request)
        draws[request.request_id] = []
    while not decoder.idle:
        for name, event in decoder.step():
            if isinstance(event, Failed):
                raise event.error
            if isinstance(event, DrawFinished):
                draws[name].append(event.draw)
    for each in draws.values():
        each.sort(key=lambda draw: draw.index)
    return draws
