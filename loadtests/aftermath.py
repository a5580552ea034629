"""What a service still holds once all its clients are gone, by its own metrics."""

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
_PATIENCE_S: Final = 30.0
_PAUSE_S: Final = 0.2


def left_behind(target: Target) -> dict[str, float]:
    """Gauges that do not go back to 0 within half a minute; those that the service has.

    Raises:
        ServiceAway: it has no metrics to be read.
    """
    until = time.monotonic() + _PATIENCE_S
    with httpx.Client(base_url=target.url, headers=target.headers, trust_env=False) as http:
        while True:
            try:
                answer = http.get("/metrics").raise_for_status()
            except httpx.HTTPError as error:
                raise ServiceAway(f"{target.url} does not show its metrics: {error}") from error
            held = {
                sample.name: sample.value
                for family in text_string_to_metric_families(answer.text)
                for sample in family.samples
                if sample.name in HELD
            }
            if not any(held.values()) or time.monotonic() > until:
                return held
            time.sleep(_PAUSE_S)
