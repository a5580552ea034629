"""Memory of a process and its children, watched over a run."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import psutil

_EDGE: Final = 0.1
"""Share of the watch whose median stands for its beginning, and for its end."""


@dataclass(frozen=True)
class MemoryReading:
    """Resident memory at one time, in seconds on the run's clock."""

    at_s: float
    rss_bytes: int


class MemoryWatch:
    """Reads the resident memory of process ``pid`` and its children every ``every_s`` seconds.

    Raises:
        ValueError: there is no such process.
    """

    def __init__(self, pid: int, every_s: float) -> None:
        try:
            self._process = psutil.Process(pid)
        except psutil.NoSuchProcess as error:
            raise ValueError(f"there is no process {pid} to watch") from error
        self._every_s = every_s
        self._ended = threading.Event()
        self._readings: list[tuple[float, int]] = []
        self._thread = threading.Thread(target=self._watch, name="memory watch")

    def __enter__(self) -> MemoryWatch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def readings(self, starts_at: float) -> list[MemoryReading]:
        """What was read, on the clock of a run that began at ``starts_at`` of `time.monotonic`."""
        return [MemoryReading(at - starts_at, rss) for at, rss in self._readings]

    def _watch(self) -> None:
        while True:
            try:
                family = [self._process, *self._process.children(recursive=True)]
                rss = sum(each.memory_info().rss for each in family)
            except psutil.NoSuchProcess:
                if not self._process.is_running():
                    return
            else:
                self._readings.append((time.monotonic(), rss))
            if self._ended.wait(self._every_s):
                return


@dataclass(frozen=True)
class Growth:
    """How memory went.

    Attributes:
        first_bytes, middle_bytes, last_bytes: medians of the first tenth of the readings, the tenth in the
            middle, and the last.
        bytes_per_hour: slope of the line through all of them, by least squares.
    """

    first_bytes: int
    middle_bytes: int
    last_bytes: int
    bytes_per_hour: float

    @property
    def late(self) -> float:
        """Growth over the second half, as a share: caches and pools have filled up in the first."""
        return self.last_bytes / self.middle_bytes - 1

    def to_json(self) -> dict[str, Any]:
        """For scripts."""
        return {
            "first_bytes": self.first_bytes,
            "middle_bytes": self.middle_bytes,
            "last_bytes": self.last_bytes,
            "growth_bytes": self.last_bytes - self.first_bytes,
            "growth_bytes_per_hour": self.bytes_per_hour,
            "late_growth": self.late,
        }


def growth(readings: Sequence[MemoryReading]) -> Growth | None:
    """Growth over ``readings``; None where there are less than two."""
    if len(readings) < 2:
        return None
    at_s, rss = (
        np.array(column, float)
        for column in zip(*((each.at_s, each.rss_bytes) for each in readings), strict=True)
    )
    edge = max(1, int(len(rss) * _EDGE))
    slope = np.polyfit(at_s - at_s[0], rss, 1)[0]
    middle = (len(rss) - edge) // 2
    first, half, last = (
        int(np.median(part)) for part in (rss[:edge], rss[middle : middle + edge], rss[-edge:])
    )
    return Growth(first, half, last, float(slope * 3600))
