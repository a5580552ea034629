"""What figures depend on: the client's machine, versions, and the service by its models and metrics."""

from __future__ import annotations

import os
import platform
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import httpx
import psutil
from prometheus_client.parser import text_string_to_metric_families
from pydantic import ValidationError

from looktwice.clients import wire
from looktwice.loadtests.mix import Mix
from looktwice.loadtests.sending import ServiceTarget

_ANSWER_WITHIN_S: Final = 10.0


class ServiceAway(RuntimeError):
    """The service to be tested does not answer as a LookTwice service does."""


def describe_client() -> dict[str, Any]:
    """The machine that makes the load; its name is nobody's business."""
    return {
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "memory_bytes": psutil.virtual_memory().total,
        "load_average": os.getloadavg()[0],
        "system": platform.platform(),
    }


def versions() -> dict[str, str]:
    """Of what makes and measures the load."""
    found = {"python": platform.python_version()}
    for package in ("looktwice", "httpx", "hdrhistogram", "numpy"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed as a package"
    return found


def describe_service(target: ServiceTarget, mix: Mix) -> dict[str, Any]:
    """The models behind the service.

    Raises:
        ServiceAway: no answer, or not one of the contract.
        ValueError: they cannot do what the mix asks for.
    """
    try:
        answer = httpx.get(
            f"{target.url}/v1/models", headers=target.headers, timeout=_ANSWER_WITHIN_S, trust_env=False
        )
        answer.raise_for_status()
        cards = wire.ModelList.model_validate_json(answer.content).models
    except (httpx.HTTPError, httpx.InvalidURL, ValidationError) as error:
        raise ServiceAway(f"{target.url} is not ready to be tested: {error}") from error
    if mix.works.get("imagine") and not any(card.imagines and card.paints for card in cards):
        names = ", ".join(card.name for card in cards) or "no model"
        raise ValueError(f"the mix has imagine, and {target.url} serves {names}: no pictures can be imagined")
    return {
        "models": [card.model_dump(include={"name", "revision", "engine", "parameters"}) for card in cards]
    }


def _cpu() -> str:
    about = Path("/proc/cpuinfo")
    lines = about.read_text().splitlines() if about.exists() else []
    return next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")),
        platform.machine(),
    )


HELD: Final = (
    "looktwice_plans_in_flight",
    "looktwice_kv_rows_used",
    "looktwice_queue_scenes",
    "looktwice_queue_draws",
)
_LOST: Final = "looktwice_log_lines_lost_total"
_RELEASED_WITHIN_S: Final = 30.0
_PAUSE_S: Final = 0.2


def left_behind(target: ServiceTarget) -> dict[str, float]:
    """Gauges that do not go back to 0 within half a minute; those that the service has.

    Raises:
        ServiceAway: it has no metrics to be read.
    """
    until = time.monotonic() + _RELEASED_WITHIN_S
    while True:
        held = {name: value for name, value in _samples(target).items() if name in HELD}
        if not any(held.values()) or time.monotonic() > until:
            return held
        time.sleep(_PAUSE_S)


def lines_lost(target: ServiceTarget) -> int:
    """Lines of the service's log that nobody took; raises `ServiceAway` as `left_behind` does."""
    return int(_samples(target).get(_LOST, 0))


def _samples(target: ServiceTarget) -> dict[str, float]:
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
