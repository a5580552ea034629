"""Our egodriver against carla-driver-interface: its runner drives us, its server is what we compare with."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import grpc
import pytest
from carla_driver_interface.cli import main as carla_driver_interface
from carla_driver_interface.policies import ConstantSpeedPolicy
from carla_driver_interface.protocol import EgodriverServiceStub, channel_options
from carla_driver_interface.server import build_server
from carla_driver_interface.testing import FakeCamera, FakeLoop, LoopResult

from looktwice.clients.alpasim.driver import DriverConfig
from looktwice.clients.alpasim.session import CAMERAS
from tests.clients.alpasim.driving import (
    READY_US,
    STEP_US,
    Driving,
    close,
    drive,
    driving,
    egomotion,
    image,
    observe,
    route,
    start,
)

SESSIONS = 8
STEPS = 20
WAITING = READY_US // STEP_US
RIG = [
    FakeCamera(CAMERAS["front_wide_120"], width=96, height=48, fov_deg=100.0),
    FakeCamera(CAMERAS["front_tele_30"], width=96, height=48, fov_deg=30.0),
]


@pytest.fixture(params=["tcp", "unix"])
def served(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Driving]:
    host = "127.0.0.1" if request.param == "tcp" else f"unix://{tmp_path}/driver.sock"
    with driving(host=host) as made:
        yield made


def run(address: str, number: int) -> LoopResult:
    with FakeLoop(address, RIG, initial_speed_mps=8.0, initial_lateral_offset_m=0.1 * number) as loop:
        return loop.run(STEPS, seed=number)


def test_the_runner_drives_eight_sessions_at_once(served: Driving) -> None:
    with ThreadPoolExecutor(SESSIONS) as pool:
        results = list(pool.map(lambda number: run(served.address, number), range(SESSIONS)))
    for number, result in enumerate(results):
        assert result.steps == STEPS
        assert not result.terminated_by_policy
        # Without a plan the runner holds; with one it follows it exactly.
        assert result.speeds_mps[1 : WAITING + 1] == [0.0] * WAITING
        assert result.lateral_offsets_m[0] == pytest.approx(0.1 * number)
    assert served.driver.sessions == 0
    asked = served.engine.submitted
    assert len(asked) == SESSIONS * (STEPS - WAITING)
    assert {request.scene.route is None for request in asked} == {False}
    assert {clip.camera for request in asked for clip in request.scene.clips} == set(CAMERAS)


def test_one_after_the_other_gives_the_same_as_together(served: Driving) -> None:
    alone = [run(served.address, number) for number in range(2)]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(lambda number: run(served.address, number), range(2)))
    for one, other in zip(alone, together, strict=True):
        assert one.speeds_mps == other.speeds_mps
        assert (one.ego.positions == other.ego.positions).all()


def test_the_packages_own_command_drives_us(capsys: pytest.CaptureFixture[str]) -> None:
    config = DriverConfig(cameras=dict.fromkeys(CAMERAS, "camera_front"))
    with driving(config) as made:
        done = carla_driver_interface(["demo", "--driver", made.address, "--steps", "20"])
    assert done == 0
    assert "terminated by policy: False" in capsys.readouterr().out


def conversation() -> list[tuple[str, Callable[[Any], object]]]:
    """What a runtime may do, right and wrong, step by step; what is returned is compared."""
    wide, tele = CAMERAS.values()
    ahead = route("one", READY_US, (0.0, 0.0), (90.0, 0.0))
    return [
        ("drive without a session", lambda stub: drive(stub, "one", 0)),
        ("close without a session", lambda stub: close(stub, "one")),
        ("start", lambda stub: start(stub, "one")),
        ("start again", lambda stub: start(stub, "one")),
        ("drive without a pose", lambda stub: len(drive(stub, "one", 0).trajectory.poses)),
        ("an unknown camera", lambda stub: stub.submit_image_observation(image("one", "x", 0))),
        ("a picture for nobody", lambda stub: stub.submit_image_observation(image("two", wide, 0))),
        ("a picture", lambda stub: stub.submit_image_observation(image("one", wide, 0))),
        ("another camera's", lambda stub: stub.submit_image_observation(image("one", tele, 0))),
        (
            "too many states",
            lambda stub: stub.submit_egomotion_observation(egomotion("one", (0, 0.0), states=2)),
        ),
        ("no states", lambda stub: stub.submit_egomotion_observation(egomotion("one", (0, 0.0), states=0))),
        ("a pose again", lambda stub: stub.submit_egomotion_observation(egomotion("one", (0, 0.0)))),
        ("observations", lambda stub: observe(stub, "one", begins_us=STEP_US)),
        ("a route", lambda stub: stub.submit_route(ahead)),
        ("a route for nobody", lambda stub: stub.submit_route(route("two", 0))),
        ("drive", lambda stub: shape(drive(stub, "one"))),
        ("drive again", lambda stub: shape(drive(stub, "one"))),
        ("close", lambda stub: close(stub, "one")),
        ("drive when closed", lambda stub: drive(stub, "one")),
        ("start once more", lambda stub: start(stub, "one")),
    ]


def shape(response: Any) -> object:
    """What all drivers' plans have in common."""
    poses = response.trajectory.poses
    place = poses[0].pose.vec
    apart_us = {late.timestamp_us - early.timestamp_us for early, late in pairwise(poses)}
    return (place.x, place.y, place.z), poses[0].timestamp_us, apart_us, response.terminate_session


def heard(stub: Any) -> list[tuple[str, object]]:
    """What each step of the conversation came to: its answer, or its status."""
    answers: list[tuple[str, object]] = []
    for name, call in conversation():
        try:
            answers.append((name, call(stub)))
        except grpc.RpcError as error:
            answers.append((name, error.code() if isinstance(error, grpc.Call) else error))
    return answers


def test_a_runtime_sees_what_the_packages_own_server_shows() -> None:
    with ExitStack() as stack:
        server, port = build_server(ConstantSpeedPolicy(), port=0, host="127.0.0.1", mode="alpasim")
        server.start()
        stack.callback(lambda: server.stop(1.0).wait())
        theirs = stack.enter_context(grpc.insecure_channel(f"127.0.0.1:{port}", options=channel_options()))
        ours = stack.enter_context(driving())
        expected = heard(EgodriverServiceStub(theirs))  # type: ignore[no-untyped-call]  # generated
        assert heard(ours.stub) == expected
