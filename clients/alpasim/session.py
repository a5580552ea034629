"""One rollout: what a runtime has told about it, and the scene to plan for. No gRPC here."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.clients.alpasim.egomotion import EgoLog, Observed
from looktwice.clients.alpasim.errors import BadObservation, BadSession
from looktwice.clients.alpasim.frames import FrameLog
from looktwice.clients.alpasim.route import route_ahead
from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE, Clip, Scene
from looktwice.model.driving.trajectory import FloatArray, from_ego_frame, to_ego_frame

CAMERAS: Final[Mapping[str, str]] = {
    FRONT_WIDE: "camera_front_wide_120fov",
    FRONT_TELE: "camera_front_tele_30fov",
}
"""Our cameras, and what alpasim calls those that look alike."""


@dataclass(frozen=True, eq=False)
class PlanInput:
    """What there is to plan for.

    Attributes:
        scene: in the ego frame of the instant.
        present: the ego's pose in the runtime's world then.
    """

    scene: Scene
    present: Observed


class Session:
    """Observations of one rollout.

    Args:
        session_id: the runtime's name for it.
        seed: of its draws.
        declared: the logical ids of the vehicle's cameras.
        cameras: the cameras that the model needs, with the logical ids that play them.

    Raises:
        BadSession: one of them is not declared.
    """

    def __init__(
        self, session_id: str, seed: int, declared: Collection[str], cameras: Mapping[str, str]
    ) -> None:
        if missing := {camera: name for camera, name in cameras.items() if name not in declared}:
            wanted = ", ".join(f"{name} (as {camera})" for camera, name in missing.items())
            raise BadSession(
                f"the vehicle lacks {wanted}; it has {', '.join(sorted(declared)) or 'no camera'}: "
                "name others with --camera OURS=LOGICAL_ID"
            )
        self.session_id, self.seed = session_id, seed
        self.drives = 0
        self._declared = frozenset(declared)
        self._cameras = dict(cameras)
        self._frames = {name: FrameLog(name) for name in cameras.values()}
        self._ego = EgoLog()
        self._route: tuple[int, npt.NDArray[np.float64]] | None = None
        self._world_route: npt.NDArray[np.float64] | None = None

    def uses(self, logical_id: str) -> bool:
        """Whether pictures of a camera are looked at; raises `BadObservation` where it is not declared."""
        if logical_id not in self._declared:
            raise BadObservation(
                f"camera {logical_id!r} was not declared; declared are {', '.join(sorted(self._declared))}"
            )
        return logical_id in self._frames

    def add_picture(self, logical_id: str, time_us: int, picture: bytes) -> None:
        """A picture of a camera that is used, with the time when it was complete."""
        self._frames[logical_id].add(time_us, picture)

    def add_pose(self, time_us: int, observed: Observed) -> None:
        """A pose of the ego in the world."""
        self._ego.add(time_us, observed)
        self._place_route()

    def set_route(self, time_us: int, waypoints: npt.ArrayLike) -> None:
        """The way to go: waypoints [n, 2] in the ego frame of ``time_us``; none forgets it."""
        self._route = (time_us, np.asarray(waypoints, np.float64).reshape(-1, 2))
        self._world_route = None
        self._place_route()

    def counts(self) -> dict[str, int]:
        """How much is remembered: poses, and pictures by camera."""
        return {"poses": len(self._ego)} | {name: len(frames) for name, frames in self._frames.items()}

    def moment(self, now_us: int) -> PlanInput:
        """The scene at ``now_us``.

        Raises:
            TooEarly: pictures or poses are still missing.
            BadHistory: they are too old, or have gaps.
        """
        clips = tuple(Clip(camera, self._frames[name].clip(now_us)) for camera, name in self._cameras.items())
        present = self._ego.present(now_us)
        history = self._ego.history(now_us)
        scene = Scene(self.session_id, clips, history, self._route_seen_from(present))
        return PlanInput(scene, present)

    def _place_route(self) -> None:
        # Its pose may come in before the route or after it.
        if self._route is not None and self._ego.covers(self._route[0]):
            time_us, waypoints = self._route
            self._world_route = from_ego_frame(_as_poses(waypoints), self._ego.at([time_us])[0])
            self._route = None

    def _route_seen_from(self, present: Observed) -> FloatArray | None:
        if self._world_route is None:
            return None
        return route_ahead(to_ego_frame(self._world_route, present.pose)[:, :2])


def _as_poses(points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.concatenate([points, np.zeros_like(points)], axis=1)
