"""The border where MetaDrive's y axis (positive to the right) becomes ours (positive to the left).

Nothing else in this project sees a coordinate of MetaDrive.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Points = npt.NDArray[np.float64]


def points_from_metadrive(points: npt.ArrayLike) -> Points:
    """Points [n, 2] of MetaDrive in a right-handed frame: x as it is, y turned round."""
    flipped = np.array(points, dtype=np.float64).reshape(-1, 2)
    flipped[:, 1] *= -1
    return flipped


def centre_line_from_metadrive(lane: Any, spacing_m: float) -> Points:
    """The centre line of a lane of MetaDrive in driving direction, evenly spaced."""
    length = float(lane.length)
    count = max(2, round(length / spacing_m) + 1)
    return points_from_metadrive([tuple(lane.position(s, 0.0)) for s in np.linspace(0.0, length, count)])
