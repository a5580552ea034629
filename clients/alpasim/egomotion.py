"""Where the ego was: poses in the world as they come in, and the model's history made of them."""

from __future__ import annotations

from bisect import bisect_left
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from looktwice.clients.alpasim.errors import BadHistory, TooEarly
from looktwice.model.driving.trajectory import HISTORY_STEPS, STEP_S, FloatArray, to_ego_frame

Array = npt.NDArray[np.float64]

STEP_US: Final = round(STEP_S * 1e6)
SPAN_US: Final = (HISTORY_STEPS - 1) * STEP_US
KEPT_US: Final = 2 * SPAN_US
"""Poses older than this, seen from the newest, are dropped."""
MAX_AGE_US: Final = 2 * STEP_US
"""A newest pose that is older than this says nothing about where the ego is."""
MAX_GAP_US: Final = 500_000
"""Between poses is a straight line; over more than this it would be a guess."""


class Observed(NamedTuple):
    """One pose in the world: x, y, z in m and heading in rad, and its whole rotation (x, y, z, w)."""

    pose: tuple[float, float, float, float]
    rotation: tuple[float, float, float, float]


class EgoLog:
    """The ego's latest poses, in order of time."""

    def __init__(self) -> None:
        self._times_us: list[int] = []
        self._observed: list[Observed] = []

    def __len__(self) -> int:
        return len(self._times_us)

    def add(self, time_us: int, observed: Observed) -> None:
        """Keep a pose; one of a time that is known already is a pose sent again, and changes nothing."""
        place = bisect_left(self._times_us, time_us)
        if place < len(self._times_us) and self._times_us[place] == time_us:
            return
        self._times_us.insert(place, time_us)
        self._observed.insert(place, observed)
        old = bisect_left(self._times_us, self._times_us[-1] - KEPT_US)
        del self._times_us[:old], self._observed[:old]

    def at(self, times_us: npt.ArrayLike) -> Array:
        """Poses [n, 4] in the world at times within the log, straight on between those that are known."""
        known = np.array([each.pose for each in self._observed])
        known[:, 3] = np.unwrap(known[:, 3])
        times = np.asarray(times_us, np.float64)
        return np.stack([np.interp(times, self._times_us, known[:, axis]) for axis in range(4)], axis=-1)

    def covers(self, time_us: int) -> bool:
        """Whether there are poses on both sides of a time."""
        return bool(self._times_us) and self._times_us[0] <= time_us <= self._times_us[-1]

    def present(self, now_us: int) -> Observed:
        """The pose at ``now_us``; the newest one where that is a little older.

        Raises:
            TooEarly: there is no pose yet.
            BadHistory: the newest one is too old.
        """
        if not self._times_us or now_us < self._times_us[0]:
            raise TooEarly("no pose of the ego yet")
        age_us = now_us - self._times_us[-1]
        if age_us > MAX_AGE_US:
            raise BadHistory(f"the newest pose is {age_us / 1e6:.2f} s old; send one for each drive")
        if age_us >= 0:
            return self._observed[-1]
        after = bisect_left(self._times_us, now_us)
        x, y, z, heading = self.at([now_us])[0].tolist()
        return Observed((x, y, z, heading), self._observed[after].rotation)

    def history(self, now_us: int) -> FloatArray:
        """The model's history [16, 4] in the ego frame, ending with `present`; raises as that does."""
        present = self.present(now_us)
        ends_us = min(now_us, self._times_us[-1])
        begins_us = ends_us - SPAN_US
        if self._times_us[0] > begins_us:
            there_s = (ends_us - self._times_us[0]) / 1e6
            raise BadHistory(f"poses cover {there_s:.2f} s before now; {SPAN_US / 1e6:.1f} s are needed")
        first, last = bisect_left(self._times_us, begins_us), bisect_left(self._times_us, ends_us)
        gaps_us = np.diff(self._times_us[max(first - 1, 0) : last + 1])
        if len(gaps_us) and gaps_us.max() > MAX_GAP_US:
            raise BadHistory(f"poses have a gap of {gaps_us.max() / 1e6:.2f} s; send them at 10 Hz")
        rows = to_ego_frame(self.at(np.arange(HISTORY_STEPS) * STEP_US + begins_us), present.pose)
        # Exactly the present, which rounding of large coordinates would miss.
        rows[-1] = 0.0
        return rows.astype(np.float32)
