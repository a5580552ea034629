"""How many CPU threads a container may really use."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Final

import torch

_CGROUP: Final = Path("/sys/fs/cgroup")


def granted_cpus(cgroup: Path = _CGROUP) -> int | None:
    """CPUs that this process' control group grants, rounded up; None where it sets no limit.

    Args:
        cgroup: where its files are: ``cpu.max`` (version 2), or ``cpu/cpu.cfs_quota_us`` and
            ``cpu/cpu.cfs_period_us`` (version 1).
    """
    try:
        if (limit := cgroup / "cpu.max").exists():
            quota, period = limit.read_text().split()
        else:
            quota, period = (
                (cgroup / "cpu" / f"cpu.cfs_{what}_us").read_text() for what in ("quota", "period")
            )
        share = float(quota) / float(period)
    except (OSError, ValueError):  # ValueError: "max"
        return None
    return math.ceil(share) if share > 0 else None


def fit_threads() -> None:
    """Let torch's operations on this thread use no more threads than CPUs are granted.

    torch counts the cores of the machine; where a container is granted fewer, its threads wait for each other
    until the next period of its quota. ``OMP_NUM_THREADS`` overrides it, as everywhere.
    """
    granted = granted_cpus()
    if granted is not None and "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(min(granted, torch.get_num_threads()))
