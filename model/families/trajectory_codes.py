"""A trajectory as codes: the end of a response in every family that writes trajectories so."""

from __future__ import annotations

from typing import Final, cast

from looktwice.model.formats.pieces import Codes, Literal, Sequence, Value

TRAJECTORY: Final = "trajectory"
"""The alphabet of trajectory codes: one codebook for each of its `CODES` stages."""
CODES: Final = 6
"""Trajectory codes of a trajectory (CF-VLA section 8)."""

TRAJECTORY_CODES: Final = Sequence(
    (Literal("\n<|traj_future_start|>"), Codes(TRAJECTORY, CODES), Literal("<|traj_future_end|><|im_end|>"))
)
"""The codes between their begin and end tokens, and the end of the message."""


def codes_in(value: Value) -> tuple[int, ...]:
    """The codes that are the value of `TRAJECTORY_CODES`."""
    assert isinstance(value, tuple)
    return cast("tuple[int, ...]", value)
