"""What driving many sessions at once brings: the same rollouts one by one and together, within one run."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import count
from typing import Any, Final

import grpc
import numpy as np
from carla_driver_interface.geometry import Pose, Trajectory
from carla_driver_interface.protocol import (
    AvailableCamera,
    DriveRequest,
    DriveSessionCloseRequest,
    DriveSessionRequest,
    EgodriverServiceStub,
    RolloutCameraImage,
    RolloutEgoTrajectory,
    Route,
    RouteRequest,
    Vec3,
    channel_options,
)

from looktwice.clients.alpasim.egomotion import STEP_US
from looktwice.clients.alpasim.frames import PERIOD_US
from looktwice.clients.alpasim.session import CAMERAS
from looktwice.model.driving.scene import CLIP_FRAMES, Scene
from looktwice.model.driving.trajectory import present_speed

_SEEN_FIRST: Final = CLIP_FRAMES - 1
"""Steps of observations before the first drive."""
_numbers = count()


@dataclass(frozen=True)
class Throughput:
    """Drives a second of the same rollouts; each round was done both ways.

    Attributes:
        sessions, steps: rollouts, and drives of each.
        one_by_one, together: drives a second in each round.
        alone_s, among_s: seconds of every drive, one by one and together.
    """

    sessions: int
    steps: int
    one_by_one: tuple[float, ...]
    together: tuple[float, ...]
    alone_s: tuple[float, ...]
    among_s: tuple[float, ...]

    @property
    def ratio(self) -> float:
        """How many times as many drives a second together; the median of the rounds."""
        return statistics.median(b / a for a, b in zip(self.one_by_one, self.together, strict=True))

    def to_json(self) -> dict[str, Any]:
        """The figures for scripts."""
        return {
            "sessions": self.sessions,
            "steps": self.steps,
            "rounds": len(self.together),
            "one_by_one_drives_per_s": statistics.median(self.one_by_one),
            "together_drives_per_s": statistics.median(self.together),
            "ratio": self.ratio,
            "ratios": [b / a for a, b in zip(self.one_by_one, self.together, strict=True)],
            "alone_s": _percentiles(self.alone_s),
            "among_s": _percentiles(self.among_s),
        }


def measure(address: str, scenes: Sequence[Scene], *, sessions: int, steps: int, rounds: int) -> Throughput:
    """Rollouts through the egodriver at ``address``, with the pictures of ``scenes``.

    A rollout's step is what alpasim does in half a second: poses at 10 Hz, a new picture of each camera, a
    route, one drive. A first round, which is not counted, warms everything up.
    """
    one_by_one, together = [], []
    alone_s, among_s = list[float](), list[float]()
    with ExitStack() as stack, ThreadPoolExecutor(sessions) as pool:
        rollouts = [
            _Rollout(
                stack.enter_context(grpc.insecure_channel(address, options=channel_options())),
                scenes[number % len(scenes)],
                steps,
            )
            for number in range(sessions)
        ]
        for round_ in range(rounds + 1):
            for rollout in rollouts:
                rollout.begin()
            began_s = time.perf_counter()
            alone = [rollout.run() for rollout in rollouts]
            middle_s = time.perf_counter()
            for rollout in rollouts:
                rollout.begin()
            again_s = time.perf_counter()
            among = list(pool.map(_Rollout.run, rollouts))
            ended_s = time.perf_counter()
            if round_:
                one_by_one.append(sessions * steps / (middle_s - began_s))
                together.append(sessions * steps / (ended_s - again_s))
                alone_s += [seconds for each in alone for seconds in each]
                among_s += [seconds for each in among for seconds in each]
        for rollout in rollouts:
            rollout.end()
    return Throughput(sessions, steps, tuple(one_by_one), tuple(together), tuple(alone_s), tuple(among_s))


class _Rollout:
    """One runtime that drives straight on past a scene's pictures."""

    def __init__(self, channel: grpc.Channel, scene: Scene, steps: int) -> None:
        self._stub: Any = EgodriverServiceStub(channel)  # type: ignore[no-untyped-call]  # generated
        self._scene, self._steps = scene, steps
        self._speed_mps = present_speed(scene.history)
        self._session = ""
        self._now_us = 0

    def begin(self) -> None:
        """A new session, which has seen enough to drive."""
        self.end()
        self._session, self._now_us = f"bench-{next(_numbers)}", 0
        request = DriveSessionRequest(session_uuid=self._session)
        request.rollout_spec.vehicle.available_cameras.extend(
            AvailableCamera(logical_id=name) for name in CAMERAS.values()
        )
        self._stub.start_session(request)
        self._observe(0)
        for _ in range(_SEEN_FIRST):
            self._go_on()

    def run(self) -> list[float]:
        """Seconds of each drive."""
        taken_s = []
        for _ in range(self._steps):
            self._go_on()
            began_s = time.perf_counter()
            request = DriveRequest(session_uuid=self._session, time_now_us=self._now_us)
            response = self._stub.drive(request)
            taken_s.append(time.perf_counter() - began_s)
            if not response.trajectory.poses:
                raise RuntimeError("a drive gave no plan")
        return taken_s

    def end(self) -> None:
        """Close the session, if one is open."""
        if self._session:
            self._stub.close_session(DriveSessionCloseRequest(session_uuid=self._session))
            self._session = ""

    def _go_on(self) -> None:
        self._observe(self._now_us + PERIOD_US)

    def _observe(self, until_us: int) -> None:
        times_us = list(range(self._now_us, until_us + 1, STEP_US))
        poses = [Pose.from_xyz_yaw(self._speed_mps * time_us / 1e6, 0.0, 0.0, 0.0) for time_us in times_us]
        message = RolloutEgoTrajectory(session_uuid=self._session)
        message.trajectory.CopyFrom(Trajectory(times_us, poses).to_proto())
        self._stub.submit_egomotion_observation(message)
        self._now_us = until_us
        if self._scene.route is not None:
            waypoints = [Vec3(x=float(x), y=float(y)) for x, y in self._scene.route]
            route = Route(timestamp_us=until_us, waypoints=waypoints)
            self._stub.submit_route(RouteRequest(session_uuid=self._session, route=route))
        for camera, name in CAMERAS.items():
            shown = self._scene.clip(camera).images[until_us // PERIOD_US % CLIP_FRAMES]
            # Bytes behind the end of a JPEG show nothing, and keep engines from knowing the picture already.
            picture = shown + next(_numbers).to_bytes(8, "big")
            image = RolloutCameraImage.CameraImage(
                frame_start_us=until_us, frame_end_us=until_us, image_bytes=picture, logical_id=name
            )
            self._stub.submit_image_observation(
                RolloutCameraImage(session_uuid=self._session, camera_image=image)
            )


def _percentiles(seconds: Sequence[float]) -> dict[str, float]:
    p50, p95 = np.percentile(seconds, [50, 95])
    return {"p50": float(p50), "p95": float(p95)}
