"""A real egodriver in front of a real service, and a runtime's side of a rollout."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import grpc
from carla_driver_interface.protocol import (
    AvailableCamera,
    DriveRequest,
    DriveResponse,
    DriveSessionCloseRequest,
    DriveSessionRequest,
    DynamicState,
    EgodriverServiceStub,
    Pose,
    PoseAtTime,
    Quat,
    RolloutCameraImage,
    RolloutEgoTrajectory,
    Route,
    RouteRequest,
    Trajectory,
    Vec3,
    channel_options,
)

from looktwice.clients.alpasim.driver import DriverConfig, Egodriver
from looktwice.clients.alpasim.grpc_server import start_server
from looktwice.clients.alpasim.messages import DebugFormat
from looktwice.clients.alpasim.session import CAMERAS
from looktwice.clients.planner import AsyncPlannerClient
from looktwice.service.operations.settings import Settings
from tests.service.scenes import picture
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import serve
from tests.sockets import PATIENCE_S

STEP_US = 100_000
READY_US = 1_500_000
SPEED_MPS = 10.0
_Value = TypeVar("_Value")


@dataclass
class Driving:
    """A running egodriver."""

    address: str
    stub: Any
    driver: Egodriver
    engine: ScriptedEngine
    loop: asyncio.AbstractEventLoop

    def in_loop(self, work: Coroutine[Any, Any, _Value]) -> _Value:
        """What ``work`` returns in the driver's event loop."""
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(PATIENCE_S)


@contextmanager
def driving(
    config: DriverConfig = DriverConfig(), *, host: str = "127.0.0.1", debug_format: DebugFormat = "json"
) -> Iterator[Driving]:
    """An egodriver in front of a service of its own, until the block ends."""
    engine = ScriptedEngine()
    with (
        serve(engine, Settings(max_draws=256)) as served,
        egodriver_at(served.url, config, host, debug_format) as found,
    ):
        address, driver, loop = found
        with grpc.insecure_channel(address, options=channel_options()) as channel:
            stub = EgodriverServiceStub(channel)  # type: ignore[no-untyped-call]  # generated
            yield Driving(address, stub, driver, engine, loop)


@contextmanager
def egodriver_at(
    url: str, config: DriverConfig, host: str, debug_format: DebugFormat = "json"
) -> Iterator[tuple[str, Egodriver, asyncio.AbstractEventLoop]]:
    """An egodriver that plans at ``url``, in an event loop on a thread of its own."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, name="egodriver")
    thread.start()

    async def begin() -> tuple[AsyncPlannerClient, Egodriver, grpc.aio.Server, str]:
        planner = AsyncPlannerClient(url)
        driver = Egodriver(planner, (await planner.models())[0], config)
        return (planner, driver, *await start_server(driver, host, 0, debug_format))

    async def end(planner: AsyncPlannerClient, server: grpc.aio.Server) -> None:
        await server.stop(1.0)
        await planner.close()

    planner, driver, server, address = asyncio.run_coroutine_threadsafe(begin(), loop).result(PATIENCE_S)
    try:
        yield address, driver, loop
    finally:
        asyncio.run_coroutine_threadsafe(end(planner, server), loop).result(PATIENCE_S)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(PATIENCE_S)
        loop.close()


def start(stub: Any, session: str, cameras: tuple[str, ...] = tuple(CAMERAS.values()), seed: int = 7) -> None:
    """Open a session of a vehicle with these cameras."""
    request = DriveSessionRequest(session_uuid=session, random_seed=seed)
    request.rollout_spec.vehicle.available_cameras.extend(
        AvailableCamera(logical_id=camera) for camera in cameras
    )
    stub.start_session(request, timeout=PATIENCE_S)


def close(stub: Any, session: str) -> None:
    """Close a session."""
    stub.close_session(DriveSessionCloseRequest(session_uuid=session), timeout=PATIENCE_S)


def image(session: str, camera: str, time_us: int, content: bytes | None = None) -> RolloutCameraImage:
    """A picture of one camera."""
    message = RolloutCameraImage(session_uuid=session)
    message.camera_image.logical_id = camera
    message.camera_image.frame_start_us = max(0, time_us - 30_000)
    message.camera_image.frame_end_us = time_us
    message.camera_image.image_bytes = picture("front_wide_120", 0) if content is None else content
    return message


def egomotion(session: str, *poses: tuple[int, float], states: int | None = None) -> RolloutEgoTrajectory:
    """Poses on the x axis of a world in which the ego drives along y: (time, metres gone)."""
    ahead = Quat(z=2**-0.5, w=2**-0.5)
    trajectory = Trajectory(
        poses=[
            PoseAtTime(timestamp_us=time_us, pose=Pose(vec=Vec3(x=5.0, y=gone_m, z=1.0), quat=ahead))
            for time_us, gone_m in poses
        ]
    )
    count = len(poses) if states is None else states
    return RolloutEgoTrajectory(
        session_uuid=session, trajectory=trajectory, dynamic_states=[DynamicState()] * count
    )


def route(session: str, time_us: int, *points: tuple[float, float]) -> RouteRequest:
    """A route in the ego frame of ``time_us``."""
    waypoints = [Vec3(x=x, y=y) for x, y in points]
    return RouteRequest(session_uuid=session, route=Route(timestamp_us=time_us, waypoints=waypoints))


def observe(stub: Any, session: str, until_us: int = READY_US, begins_us: int = 0) -> None:
    """Poses and pictures at 10 Hz of an ego that drives straight on."""
    for time_us in range(begins_us, until_us + 1, STEP_US):
        stub.submit_egomotion_observation(egomotion(session, (time_us, SPEED_MPS * time_us / 1e6)))
        for camera in CAMERAS.values():
            stub.submit_image_observation(image(session, camera, time_us))


def drive(stub: Any, session: str, now_us: int = READY_US, timeout_s: float = PATIENCE_S) -> DriveResponse:
    """One drive."""
    request = DriveRequest(session_uuid=session, time_now_us=now_us, time_query_us=now_us + STEP_US)
    response: DriveResponse = stub.drive(request, timeout=timeout_s)
    return response
