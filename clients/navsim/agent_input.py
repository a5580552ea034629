"""What of NAVSIM's agent input is looked at; its own dataclasses fit, and so does anything like them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy.typing as npt


class EgoStatus(Protocol):
    """The ego at one of the past instants.

    Attributes:
        ego_pose: x, y in m and heading in rad of the rear axle, in any one frame.
        ego_velocity: x, y in m/s, in the ego's own frame of that instant.
    """

    ego_pose: npt.NDArray[Any]
    ego_velocity: npt.NDArray[Any]


class Camera(Protocol):
    """One camera at one instant.

    Attributes:
        image: uint8 RGB [h, w, 3], or None where it was not loaded.
        sensor2lidar_rotation: [3, 3], from the camera's axes (x right, y down, z ahead) to the lidar's, which
            are the ego's (x forward, y left, z up).
        intrinsics: [3, 3], in pixels.
        distortion: k1, k2, p1, p2, k3 of OpenCV's model.
    """

    image: npt.NDArray[Any] | None
    sensor2lidar_rotation: npt.NDArray[Any] | None
    intrinsics: npt.NDArray[Any] | None
    distortion: npt.NDArray[Any] | None


class Cameras(Protocol):
    """The cameras that are looked at."""

    @property
    def cam_f0(self) -> Camera:
        """Straight ahead."""
        ...

    @property
    def cam_l0(self) -> Camera:
        """To the left of it."""
        ...

    @property
    def cam_r0(self) -> Camera:
        """To the right of it."""
        ...


class AgentInput(Protocol):
    """Four instants at 2 Hz, oldest first, the last one is now."""

    @property
    def ego_statuses(self) -> Sequence[EgoStatus]:
        """Of the ego."""
        ...

    @property
    def cameras(self) -> Sequence[Cameras]:
        """What was seen."""
        ...


class InputError(ValueError):
    """An agent input that cannot be planned for; the text says what is missing."""
