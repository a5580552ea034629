"""An ego that does not heed, now and then, what asks it to brake, so that scenes show how to brake late.

An expert brakes early, so nobody who learns from it sees what is close and still approached fast; who has
been late once is lost then. As with drifts, the lapse is not to be learned: no scene's future holds one.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from looktwice.clients.metadrive.world.actors import STEP_S, Vehicle

_APART_S: Final = (8.5, 11.0)
"""Longer than a scene's future, so that scenes lie between two of them."""
_FIRST_S: Final = (2.0, 6.0)
_BEGINS_AT: Final = (-1.6, -0.4)
"""m/s²: who is asked to brake so hard may miss it."""
_SLOWEST: Final = 5.0
_BEARS: Final = (1.8, 5.0)
"""m/s²: a lapse ends when braking must be harder than this."""
_GOES_ON_AT: Final = (-0.2, 0.8)
_LONGEST_S: Final = 4.0
_TOO_FAST: Final = 1.25
"""Times the speed that curves allow."""
_COMPOSED: Final = -1.5
"""m/s²: while it must brake harder than this after a lapse, it does not change lanes."""


class LateBraking:
    """Keeps one vehicle from braking in time, by a chance of its own."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng([seed, 13])
        self._left_s = float(self._rng.uniform(*_FIRST_S))
        self._lasted_s = 0.0
        self._bears = self._goes_on_at = 0.0
        self._late = False

    def absorbed(self, car: Vehicle) -> bool:
        """Whether the driver has no eyes for other lanes: it does not see what comes, or brakes for it."""
        self._late = self._late and car.acceleration < _COMPOSED
        return car.heedless or self._late

    def heeded(self, car: Vehicle, limit: float, wanted: float) -> float:
        """The next step's acceleration, m/s², where ``wanted`` is right and curves allow ``limit`` m/s."""
        self._left_s -= STEP_S
        if car.heedless:
            self._lasted_s += STEP_S
            if wanted <= -self._bears or self._lasted_s >= _LONGEST_S or car.speed > _TOO_FAST * limit:
                car.heedless, self._late = False, True
                self._left_s = float(self._rng.uniform(*_APART_S))
        elif self._left_s <= 0 and self._may_begin(car, wanted):
            car.heedless, self._lasted_s = True, 0.0
            self._bears = float(self._rng.uniform(*_BEARS))
            self._goes_on_at = float(self._rng.uniform(*_GOES_ON_AT))
        return self._goes_on_at if car.heedless else wanted

    def _may_begin(self, car: Vehicle, wanted: float) -> bool:
        steady = car.shift is None and car.drift is None and car.speed > _SLOWEST
        return steady and _BEGINS_AT[0] < wanted < _BEGINS_AT[1]
