"""`egodriver.EgodriverService` over gRPC: messages in, our driver, messages out, errors as gRPC statuses."""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from importlib.metadata import version
from typing import Any, Final

import grpc
import structlog
from carla_driver_interface.contract import contract_metadata
from carla_driver_interface.protocol import (
    ALPASIM_API_VERSION,
    ALPASIM_REV,
    DriveRequest,
    DriveResponse,
    DriveSessionCloseRequest,
    DriveSessionRequest,
    EgodriverServiceServicer,
    Empty,
    GroundTruthRequest,
    RolloutCameraImage,
    RolloutEgoTrajectory,
    RouteRequest,
    SessionRequestStatus,
    VersionId,
)

from looktwice.clients.alpasim.driver import Egodriver
from looktwice.clients.alpasim.errors import (
    BadHistory,
    BadObservation,
    BadSession,
    Draining,
    EgodriverError,
    SessionExists,
    TooManySessions,
    UnknownSession,
)
from looktwice.clients.alpasim.messages import DebugFormat, drive_response, observed, waypoints
from looktwice.clients.answers import (
    PlannerError,
    PlannerProblem,
    PlannerTimeout,
    PlannerUnreachable,
    RequestRefused,
    ServiceBusy,
)

log = structlog.stdlib.get_logger()

Context = grpc.aio.ServicerContext[Any, Any]

_STATUS: Final[Mapping[type[EgodriverError], grpc.StatusCode]] = {
    UnknownSession: grpc.StatusCode.NOT_FOUND,
    SessionExists: grpc.StatusCode.ALREADY_EXISTS,
    TooManySessions: grpc.StatusCode.RESOURCE_EXHAUSTED,
    Draining: grpc.StatusCode.UNAVAILABLE,
    BadObservation: grpc.StatusCode.INVALID_ARGUMENT,
    BadSession: grpc.StatusCode.FAILED_PRECONDITION,
    BadHistory: grpc.StatusCode.FAILED_PRECONDITION,
}
_STATUS_OF_HTTP: Final = {
    401: grpc.StatusCode.UNAUTHENTICATED,
    429: grpc.StatusCode.RESOURCE_EXHAUSTED,
    504: grpc.StatusCode.DEADLINE_EXCEEDED,
}


def status_of(error: EgodriverError | PlannerError) -> grpc.StatusCode:
    """What a caller is told; a plan that could not be made is never made up."""
    if isinstance(error, EgodriverError):
        return _STATUS.get(type(error), grpc.StatusCode.INTERNAL)
    if isinstance(error, PlannerProblem) and error.status in _STATUS_OF_HTTP:
        return _STATUS_OF_HTTP[error.status]
    if isinstance(error, PlannerTimeout):
        return grpc.StatusCode.DEADLINE_EXCEEDED
    if isinstance(error, (PlannerUnreachable, ServiceBusy)):
        return grpc.StatusCode.UNAVAILABLE
    if isinstance(error, RequestRefused):
        return grpc.StatusCode.FAILED_PRECONDITION
    return grpc.StatusCode.INTERNAL


class EgodriverServicer(EgodriverServiceServicer):
    """The contract in front of an `Egodriver`.

    Args:
        driver: drives all sessions.
        debug_format: of the debug info that comes with every drive.
    """

    def __init__(self, driver: Egodriver, debug_format: DebugFormat = "json") -> None:
        self._driver, self._debug_format = driver, debug_format

    async def get_version(self, request: Empty, context: Context) -> VersionId:
        """Who drives; the metadata says that cameras are declared as alpasim does it."""
        await context.send_initial_metadata(contract_metadata())
        card = self._driver.card
        return VersionId(
            version_id=f"looktwice-{version('looktwice')} {card.name} {card.revision}",
            git_hash=ALPASIM_REV,
            grpc_api_version=ALPASIM_API_VERSION,
        )

    async def start_session(self, request: DriveSessionRequest, context: Context) -> SessionRequestStatus:
        """Open a session."""
        async with _told(context):
            declared = {camera.logical_id for camera in request.rollout_spec.vehicle.available_cameras}
            self._driver.start_session(request.session_uuid, request.random_seed, declared)
        log.info("session started", session=request.session_uuid, sessions=self._driver.sessions)
        return SessionRequestStatus()

    async def close_session(self, request: DriveSessionCloseRequest, context: Context) -> Empty:
        """Forget a session; one that is not known is none already."""
        known = self._driver.close_session(request.session_uuid)
        log.info("session closed", session=request.session_uuid, known=known, sessions=self._driver.sessions)
        return Empty()

    async def submit_image_observation(self, request: RolloutCameraImage, context: Context) -> Empty:
        """Keep a picture."""
        image = request.camera_image
        async with _told(context):
            await self._driver.add_picture(
                request.session_uuid, image.logical_id, image.frame_end_us, image.image_bytes
            )
        return Empty()

    async def submit_egomotion_observation(self, request: RolloutEgoTrajectory, context: Context) -> Empty:
        """Keep poses; velocities and accelerations are in them."""
        async with _told(context):
            session = self._driver.session(request.session_uuid)
            poses, states = request.trajectory.poses, request.dynamic_states
            if states and len(states) != len(poses):
                raise BadObservation(f"{len(poses)} poses come with {len(states)} dynamic states")
            for each in [(pose.timestamp_us, observed(pose.pose)) for pose in poses]:
                session.add_pose(*each)
        return Empty()

    async def submit_route(self, request: RouteRequest, context: Context) -> Empty:
        """Keep the way to go."""
        async with _told(context):
            session = self._driver.session(request.session_uuid)
            session.set_route(request.route.timestamp_us, waypoints(request.route))
        return Empty()

    async def submit_recording_ground_truth(self, request: GroundTruthRequest, context: Context) -> Empty:
        """Heard, and not looked at: who plans must not know what the recorded driver did."""
        async with _told(context):
            self._driver.session(request.session_uuid)
        return Empty()

    async def drive(self, request: DriveRequest, context: Context) -> DriveResponse:
        """Plan, and answer in the runtime's world."""
        left_s = context.time_remaining()
        async with _told(context):
            driven = await self._driver.drive(
                request.session_uuid, request.time_now_us, None if left_s is None else 1000 * left_s
            )
        return drive_response(driven, request.time_now_us, self._debug_format)


@asynccontextmanager
async def _told(context: Context) -> AsyncIterator[None]:
    """Ends the call with a status where our errors come up."""
    try:
        yield
    except (EgodriverError, PlannerError) as error:
        code = status_of(error)
        log.warning("call refused", code=code.name, detail=str(error))
        await context.abort(code, str(error))
