"""Every call of the contract, over a real connection, in front of a real service."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable, Iterator
from typing import Any

import grpc
import numpy as np
import pytest
from carla_driver_interface.contract import CONTRACT_REVISION, negotiate
from carla_driver_interface.geometry import Trajectory
from carla_driver_interface.protocol import GroundTruthRequest

from looktwice.clients import wire
from looktwice.clients.alpasim.driver import DriverConfig
from looktwice.clients.alpasim.session import CAMERAS
from looktwice.model.driving.trajectory import agreed
from looktwice.model.engines.engine import EngineError
from tests.clients.alpasim.driving import (
    READY_US,
    SPEED_MPS,
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

WIDE = CAMERAS["front_wide_120"]


@pytest.fixture(scope="module")
def shared() -> Iterator[Driving]:
    with driving() as made:
        yield made


@pytest.fixture
def rollout(shared: Driving, request: pytest.FixtureRequest) -> Iterator[tuple[Driving, str]]:
    start(shared.stub, request.node.name)
    yield shared, request.node.name
    close(shared.stub, request.node.name)


def refused(call: grpc.RpcError) -> tuple[grpc.StatusCode, str]:
    assert isinstance(call, grpc.Call)
    return call.code(), str(call.details())


def test_get_version_says_who_drives_and_how_cameras_are_meant(shared: Driving) -> None:
    version, revision = negotiate(shared.stub)
    assert version.version_id.startswith("looktwice-")
    assert "scripted r1" in version.version_id
    assert revision == CONTRACT_REVISION


def test_a_plan_is_all_draws_in_the_runtimes_world(rollout: tuple[Driving, str]) -> None:
    shared, session = rollout
    observe(shared.stub, session)
    response = drive(shared.stub, session)
    sampled = [Trajectory.from_proto(each) for each in response.debug_info.sampled_trajectories]
    driven = Trajectory.from_proto(response.trajectory)
    assert not response.terminate_session
    assert len(sampled) == 6
    assert [each.timestamps_us for each in sampled] == [[READY_US + STEP_US * step for step in range(65)]] * 6
    # The world's y is the ego's x.
    gone_m = SPEED_MPS * READY_US / 1e6
    np.testing.assert_allclose(driven.positions[0], [5.0, gone_m, 1.0], atol=1e-5)
    assert driven.positions[1, 1] == pytest.approx(gone_m + 1.0, abs=0.3)
    assert driven.poses[1].yaw == pytest.approx(np.pi / 2, abs=0.1)
    places = np.stack([each.positions[1:] for each in sampled])
    chosen = agreed(places.astype(np.float32))
    np.testing.assert_allclose(driven.positions, sampled[chosen].positions)


def test_debug_info_tells_what_was_thought(rollout: tuple[Driving, str]) -> None:
    shared, session = rollout
    observe(shared.stub, session)
    told = json.loads(drive(shared.stub, session).debug_info.unstructured_debug_info)
    assert told["model"] == "scripted r1"
    assert told["plan"].startswith("- longitudinal")
    assert 0 <= told["think_probability"] <= 1
    assert (told["reasoning_text"] is None) == (told["branch"] == "Action:")
    assert told["deadline_ms"] == 90
    assert told["seed"] == 7
    assert told["seen"]["poses"] == 16
    again = json.loads(drive(shared.stub, session).debug_info.unstructured_debug_info)
    assert again["seed"] == 8


def test_alpasims_evaluation_reads_debug_info_as_a_pickled_dict() -> None:
    controls = wire.Controls(n=2, thinking="always")
    with driving(DriverConfig(controls=controls, deadline_ms=None), debug_format="pickle") as made:
        start(made.stub, "one")
        observe(made.stub, "one")
        told = pickle.loads(drive(made.stub, "one").debug_info.unstructured_debug_info)
    assert told["reasoning_text"].startswith("The vehicle ahead")
    assert told["deadline_ms"] is None
    assert made.engine.submitted[0].controls.deadline_ms is None


def test_there_is_no_plan_before_enough_was_seen(rollout: tuple[Driving, str]) -> None:
    shared, session = rollout
    for until_us in (0, READY_US - STEP_US):
        observe(shared.stub, session, until_us)
        response = drive(shared.stub, session, until_us)
        assert not response.trajectory.poses
        assert not response.debug_info.sampled_trajectories
    observe(shared.stub, session)
    assert len(drive(shared.stub, session).trajectory.poses) == 65


def test_a_stale_history_is_a_failed_precondition(rollout: tuple[Driving, str]) -> None:
    shared, session = rollout
    observe(shared.stub, session)
    with pytest.raises(grpc.RpcError) as caught:
        drive(shared.stub, session, READY_US + 500_000)
    code, details = refused(caught.value)
    assert code is grpc.StatusCode.FAILED_PRECONDITION
    assert "pose is 0.50 s old" in details


def test_the_route_reaches_the_model(rollout: tuple[Driving, str]) -> None:
    shared, session = rollout
    observe(shared.stub, session)
    shared.stub.submit_route(route(session, READY_US, *((5.0 * step, 0.0) for step in range(30))))
    drive(shared.stub, session)
    given = shared.engine.submitted[-1].scene.route
    assert given is not None
    np.testing.assert_allclose(given[:, 0], 4.0 * np.arange(1, 21), atol=1e-3)
    shared.stub.submit_route(route(session, READY_US))
    drive(shared.stub, session)
    assert shared.engine.submitted[-1].scene.route is None


def test_ground_truth_is_heard_and_changes_nothing(rollout: tuple[Driving, str]) -> None:
    shared, session = rollout
    observe(shared.stub, session)
    truth = GroundTruthRequest(session_uuid=session)
    truth.ground_truth.trajectory.CopyFrom(egomotion(session, (READY_US, 1e6)).trajectory)
    shared.stub.submit_recording_ground_truth(truth)
    drive(shared.stub, session)
    scene = shared.engine.submitted[-1].scene
    assert scene.route is None
    assert np.abs(scene.history).max() < 20.0


@pytest.mark.parametrize(
    "call",
    [
        lambda stub: stub.submit_image_observation(image("nobody", WIDE, 0)),
        lambda stub: stub.submit_egomotion_observation(egomotion("nobody", (0, 0.0))),
        lambda stub: stub.submit_route(route("nobody", 0)),
        lambda stub: stub.submit_recording_ground_truth(GroundTruthRequest(session_uuid="nobody")),
        lambda stub: drive(stub, "nobody"),
    ],
)
def test_a_session_must_be_open(shared: Driving, call: Callable[[Any], object]) -> None:
    with pytest.raises(grpc.RpcError) as caught:
        call(shared.stub)
    assert refused(caught.value)[0] is grpc.StatusCode.NOT_FOUND


def test_a_vehicle_must_have_the_models_cameras(shared: Driving) -> None:
    with pytest.raises(grpc.RpcError) as caught:
        start(shared.stub, "blind", (WIDE,))
    code, details = refused(caught.value)
    assert code is grpc.StatusCode.FAILED_PRECONDITION
    assert "lacks camera_front_tele_30fov" in details


@pytest.mark.parametrize(
    ("camera", "content", "message"),
    [("camera_unheard_of", None, "was not declared"), (WIDE, b"no picture", "cannot be used")],
)
def test_a_bad_picture_is_refused(
    rollout: tuple[Driving, str], camera: str, content: bytes | None, message: str
) -> None:
    shared, session = rollout
    with pytest.raises(grpc.RpcError) as caught:
        shared.stub.submit_image_observation(image(session, camera, 0, content))
    code, details = refused(caught.value)
    assert code is grpc.StatusCode.INVALID_ARGUMENT
    assert message in details


@pytest.mark.parametrize("poses", [[(0, 0.0), (1, float("nan"))]])
def test_a_bad_pose_is_refused_with_all_that_come_with_it(
    rollout: tuple[Driving, str], poses: list[tuple[int, float]]
) -> None:
    shared, session = rollout
    for message in (egomotion(session, *poses), egomotion(session, (0, 0.0), states=3)):
        with pytest.raises(grpc.RpcError) as caught:
            shared.stub.submit_egomotion_observation(message)
        assert refused(caught.value)[0] is grpc.StatusCode.INVALID_ARGUMENT
    assert shared.driver.session(session).counts()["poses"] == 0


def test_no_more_sessions_than_there_is_room_for() -> None:
    with driving(DriverConfig(max_sessions=2)) as made:
        start(made.stub, "one")
        start(made.stub, "two")
        with pytest.raises(grpc.RpcError) as caught:
            start(made.stub, "three")
        assert refused(caught.value)[0] is grpc.StatusCode.RESOURCE_EXHAUSTED
        close(made.stub, "one")
        start(made.stub, "three")
        assert made.driver.sessions == 2


def test_a_session_that_nobody_drives_gives_way() -> None:
    with driving(DriverConfig(max_sessions=1, idle_s=0.0)) as made:
        start(made.stub, "left behind")
        start(made.stub, "new")
        with pytest.raises(grpc.RpcError) as caught:
            drive(made.stub, "left behind")
        assert refused(caught.value)[0] is grpc.StatusCode.NOT_FOUND


def test_a_caller_that_waits_less_than_the_deadline_shortens_it() -> None:
    with driving(DriverConfig(deadline_ms=60_000)) as made:
        start(made.stub, "one")
        observe(made.stub, "one")
        drive(made.stub, "one", timeout_s=20.0)
        given_ms = made.engine.submitted[0].controls.deadline_ms
    assert given_ms is not None
    assert 5_000 < given_ms < 21_000


def test_a_planner_that_fails_is_never_made_up_for() -> None:
    with driving() as made:
        start(made.stub, "one")
        observe(made.stub, "one")
        made.engine.failure = EngineError("out of memory")
        with pytest.raises(grpc.RpcError) as caught:
            drive(made.stub, "one")
        code, details = refused(caught.value)
        assert code is grpc.StatusCode.UNAVAILABLE
        assert "the log has why" in details
        made.engine.failure = None
        assert drive(made.stub, "one").trajectory.poses


def test_a_caller_that_gives_up_stops_the_planning() -> None:
    with driving() as made:
        start(made.stub, "one")
        observe(made.stub, "one")
        made.engine.may_finish.clear()
        with pytest.raises(grpc.RpcError) as caught:
            drive(made.stub, "one", timeout_s=0.5)
        assert refused(caught.value)[0] is grpc.StatusCode.DEADLINE_EXCEEDED
        for _ in range(1000):
            if made.engine.cancelled:
                break
            close(made.stub, "nobody")
        assert len(made.engine.cancelled) == 1


def test_draining_drives_open_sessions_to_their_end_and_takes_no_new_ones() -> None:
    with driving() as made:
        start(made.stub, "open")
        observe(made.stub, "open")
        made.in_loop(made.driver.drain(0.0))
        with pytest.raises(grpc.RpcError) as caught:
            start(made.stub, "late")
        assert refused(caught.value)[0] is grpc.StatusCode.UNAVAILABLE
        assert drive(made.stub, "open").trajectory.poses
        close(made.stub, "open")
        made.in_loop(made.driver.drain(60.0))
