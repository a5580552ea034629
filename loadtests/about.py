"""What a figure depends on besides the service: the client's machine, versions, and who answered."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import httpx
import psutil
from pydantic import ValidationError

from clients import wire
from loadtests.mix import Mix
from loadtests.sending import Target

_PATIENCE_S = 10.0


class ServiceAway(RuntimeError):
    """The service to be tested does not answer as a LookTwice service does."""


def about_client() -> dict[str, Any]:
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


def about_service(target: Target, mix: Mix) -> dict[str, Any]:
    """The models behind the service.

    Raises:
        ServiceAway: no answer, or not one of the contract.
        ValueError: they cannot do what the mix asks for.
    """
    try:
        answer = httpx.get(
            f"{target.url}/v1/models", headers=target.headers, timeout=_PATIENCE_S, trust_env=False
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
