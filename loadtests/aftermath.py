"""What a service still holds, or has lost, once all its clients are gone: by its own metrics."""

from __future__ import annotations

import time
from typing import Final

import httpx
from prometheus_client.parser import text_string_to_metric_families

from loadtests.about import ServiceAway
from loadtests.sending import Target

HELD: Final = (
    "looktwice_plans_in_flight",
    "looktwice_kv_rows_used",
    "looktwice_queue_scenes",
    "looktwice_queue_draws",
)
_LOST: Final = "looktwice_log_lines_lost_total"
_PATIENCE_S: Final = 30.0
_PAUSE_S: Final = 0.2


def left_behind(target: Target) -> dict[str, float]:
    """Gauges that do not go back to 0 within half a minute; those that the service has.

    Raises:
        ServiceAway: it has no metrics to be read.
    """
    until = time.monotonic() + _PATIENCE_S
    while True:
        held = {name: value for name, value in _samples(target).items() if name in HELD}
        if not any(held.values()) or time.monotonic() > until:
            return held
        time.sleep(_PAUSE_S)


def lines_lost(target: Target) -> int:
    """Lines of the service's log that nobody took; raises `ServiceAway` as `left_behind` does."""
    return int(_samples(target).get(_LOST, 0))


def _samples(target: Target) -> dict[str, float]:
    try:
        answer = httpx.get(f"{target.url}/metrics", headers=target.headers, trust_env=False)
        answer.raise_for_status()
    except httpx.HTTPError as error:
        raise ServiceAway(f"{target.url} does not show its metrics: {error}") from error
    return {
        sample.name: sample.value
        for family in text_string_to_metric_families(answer.text)
        for sample in family.samples
    }
