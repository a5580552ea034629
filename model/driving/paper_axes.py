"""Axes of VLA-World and of nuScenes's open-loop protocols, at the border to ours.

There a point is (lateral, forward), and what lies to the left is negative (VLA-World, figure 5). Here it is
(x ahead, y to the left).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def to_paper_axes(xy_m: npt.ArrayLike) -> Array:
    """Points [..., 2] in the ego frame (ahead, left) as (to the right, ahead)."""
    points = np.asarray(xy_m, np.float64)
    return np.stack([-points[..., 1], points[..., 0]], axis=-1)


def from_paper_axes(xy_m: npt.ArrayLike) -> Array:
    """Points [..., 2] as (to the right, ahead) in the ego frame (ahead, left): `to_paper_axes` undone."""
    points = np.asarray(xy_m, np.float64)
    return np.stack([points[..., 1], -points[..., 0]], axis=-1)
