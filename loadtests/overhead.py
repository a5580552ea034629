"""What HTTP adds to planning: answer time minus time in the engine, one request after the other."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import httpx

from looktwice.clients.wire import PlanResponse
from looktwice.loadtests.bodies import make_calls
from looktwice.loadtests.mix import Payload, parse_mix
from looktwice.model.driving.scene import LabelledScene

PAYLOADS: tuple[Payload, ...] = ("json", "msgpack", "multipart")


class NoAnswer(RuntimeError):
    """The service did not answer with plans."""


@dataclass(frozen=True)
class Overhead:
    """Medians over the measured requests of one kind of body.

    Attributes:
        payload: which kind.
        requests: how many were measured.
        body_bytes: of a request.
        engine_ms: in the engine, as the answer says.
        overhead_ms: the rest of the time until the answer was read.
        before_ms: of that: in the service, before the engine and behind it.
    """

    payload: Payload
    requests: int
    body_bytes: int
    engine_ms: float
    overhead_ms: float
    before_ms: float

    @property
    def share(self) -> float:
        """Overhead over time in the engine."""
        return self.overhead_ms / self.engine_ms


def measure(
    http: httpx.Client, scenes: Sequence[LabelledScene], *, n: int, requests: int, seed: int = 0
) -> Iterator[Overhead]:
    """The overhead of each kind of body, a few requests for warming up apart.

    No two requests have the same pictures, and another ``seed`` brings others.

    Raises:
        NoAnswer: an answer is no plan.
        httpx.HTTPError: the service is not there.
    """
    for place, payload in enumerate(PAYLOADS):
        own_seed = seed * len(PAYLOADS) + place
        mix = parse_mix("plan", str(n), payload, "none", 0)
        spent: list[tuple[float, float, float]] = []
        calls = make_calls(scenes, mix.kinds(requests + 3, own_seed), own_seed)
        for call in calls:
            began_s = time.perf_counter()
            answer = http.post(call.path, content=call.body, headers=dict(call.headers))
            answer_ms = 1000 * (time.perf_counter() - began_s)
            if answer.status_code != 200:
                raise NoAnswer(f"the service answered {answer.status_code}: {answer.text[:300]}")
            timing = PlanResponse.model_validate_json(answer.content).timing
            overhead_ms = answer_ms - timing.engine_ms
            spent.append((timing.engine_ms, overhead_ms, timing.total_ms - timing.engine_ms))
        medians = [statistics.median(column) for column in zip(*spent[3:], strict=True)]
        yield Overhead(payload, requests, len(calls[-1].body), *medians)
