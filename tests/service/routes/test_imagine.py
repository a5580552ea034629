"""POST /v1/imagine and the choice to imagine over a real socket, with an untrained checkpoint."""

from __future__ import annotations

import asyncio
import base64
import io
import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from PIL import Image

import looktwice.clients.wire as wire
from looktwice.clients.planner import (
    AsyncPlannerClient,
    PlannerClient,
    RequestRefused,
    ServiceBusy,
    imagine_request,
)
from looktwice.clients.streams import ImagineEvent
from looktwice.clients.wire_imagine import CodesWritten, ImagineControls, ImagineRequest, ImagineResponse
from looktwice.model.driving.scene import CAMERAS
from looktwice.model.driving.trajectory import TEN_HZ_S, at_times
from looktwice.model.engines.engine import EngineError
from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.model.engines.torch.shortcuts import Shortcuts
from looktwice.model.families.picture_codes import BLANK, LEVELS, levels_of
from looktwice.model.network.checkpoint import load, save
from looktwice.model.network.visual_codes import VisualCodes, load_visual_codes
from looktwice.model.network.vla_settings import VlaSettings
from looktwice.service.operations.no_model import NoModel
from looktwice.service.operations.settings import Settings
from looktwice.service.routes.request_examples import example_imagining
from tests.checkpoints import write_untrained
from tests.service.http.test_problem_documents import problem
from tests.service.scenes import scene
from tests.service.scripted_engine import CARD, ScriptedEngine
from tests.service.serving import Served, body, serve
from tests.sockets import PATIENCE_S

PATH = "/v1/imagine"
SEEN = ("front_wide_120", "front_tele_30")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    settings = VlaSettings(name="world", formats=("traj_only", "vla_world"), reflection="phrases")
    folder = tmp_path_factory.mktemp("world") / "checkpoint"
    loaded = load(write_untrained(folder, narrow=True, settings=settings))
    codes = VisualCodes(24)
    save(folder, loaded.model, loaded.vocabulary, loaded.codec, visual_codes=codes)
    return folder


@pytest.fixture(scope="module")
def served(checkpoint: Path) -> Iterator[Served[TorchEngine]]:
    with serve(
        TorchEngine(checkpoint, TorchSettings(rows=4, products=None)), Settings(queue_timeout_s=PATIENCE_S)
    ) as running:
        yield running


def asked(**changes: Any) -> dict[str, Any]:
    return {**example_imagining(SEEN), **changes}


def imagined(served: Served[Any], document: dict[str, Any]) -> ImagineResponse:
    answer = served.http.post(PATH, json=document)
    assert answer.status_code == 200, answer.text
    return ImagineResponse.model_validate_json(answer.content)


def pixels(image: str) -> np.ndarray[Any, Any]:
    picture = Image.open(io.BytesIO(base64.b64decode(image)))
    assert (picture.format, picture.size) == ("PNG", (224, 112))
    return np.asarray(picture)


def test_pictures_are_painted_of_the_codes_that_were_drawn(
    served: Served[TorchEngine], checkpoint: Path
) -> None:
    codec = load_visual_codes(checkpoint)
    told = imagined(served, asked(camera="back_left", controls={"n": 3, "seed": 1, "codes": "drawn"}))
    assert (told.format, told.camera, told.seconds) == ("vla_world", "back_left", 0.5)
    assert [each.index for each in told.pictures] == [0, 1, 2]
    for each in told.pictures:
        np.testing.assert_array_equal(pixels(each.image), codec.decode(each.codes))
        # An untrained model finds all 1,000 codes about as likely.
        assert each.logprob / 98 == pytest.approx(-np.log(1000), rel=0.3)
        assert len(each.perception.objects) <= 8
        assert each.prediction.direction in ("Left", "Forward", "Right")
    assert len({tuple(each.codes) for each in told.pictures}) == 3
    assert told.timing.total_ms >= told.timing.engine_ms > 0


def test_codes_of_least_expected_error_are_taken_unless_they_are_to_be_drawn(
    served: Served[TorchEngine],
) -> None:
    told = imagined(served, asked(camera="back_left", controls={"n": 2}))
    # An untrained model finds all levels about as likely, and the middle ones are the least off.
    levels = levels_of([each.codes for each in told.pictures]) / (np.array(LEVELS) - 1)
    assert (np.abs(levels - 0.5) < 0.3).all()


def test_the_same_seed_imagines_the_same_and_another_camera_something_else(
    served: Served[TorchEngine],
) -> None:
    first = imagined(served, asked())
    assert imagined(served, asked()).pictures == first.pictures
    assert imagined(served, asked(camera="back")).pictures != first.pictures
    assert imagined(served, asked(controls={"n": 2, "seed": 8})).pictures != first.pictures


def test_what_the_camera_sees_now_changes_no_picture(served: Served[TorchEngine], checkpoint: Path) -> None:
    settings = TorchSettings(rows=4, products=None, shortcuts=replace(Shortcuts(), speculate=False))
    request = asked(camera=SEEN[0])
    with serve(TorchEngine(checkpoint, settings), Settings()) as plain:
        expected = imagined(plain, request)
    assert imagined(served, request).pictures == expected.pictures
    other = asked(camera=SEEN[0], scene=asked()["scene"] | {"route": None})
    assert imagined(served, other).pictures != expected.pictures


def test_clients_imagine_too_in_both_kinds(served: Served[TorchEngine]) -> None:
    request = imagine_request(scene(), "front", ImagineControls(n=2, seed=3))
    with PlannerClient(served.url) as planner:
        assert [(card.imagines, card.paints) for card in planner.models()] == [(["vla_world"], True)]
        told = planner.imagine(request)

    async def asynchronously() -> ImagineResponse:
        async with AsyncPlannerClient(served.url) as planner:
            return await planner.imagine(request)

    assert asyncio.run(asynchronously()).pictures == told.pictures
    packed = served.http.post(
        PATH,
        content=msgpack.packb(request.model_dump()),
        headers={"Content-Type": wire.MSGPACK_MEDIA_TYPE, "Accept": wire.MSGPACK_MEDIA_TYPE},
    )
    assert ImagineResponse.model_validate(msgpack.unpackb(packed.content)).pictures == told.pictures


def events_of(served: Served[Any], **changes: Any) -> list[tuple[str, ImagineEvent]]:
    request = ImagineRequest.model_validate_json(json.dumps(asked(**changes)))
    with PlannerClient(served.url) as planner:
        return list(planner.stream_imagine(request))


def test_a_stream_tells_of_pictures_as_they_are_written(served: Served[TorchEngine]) -> None:
    plain = imagined(served, asked(controls={"n": 3, "seed": 1}))
    events = events_of(served, controls={"n": 3, "seed": 1})
    name, done = events[-1]
    assert (name, isinstance(done, ImagineResponse)) == ("done", True)
    assert isinstance(done, ImagineResponse)
    assert done.pictures == plain.pictures
    for picture in plain.pictures:
        own = [(name, told) for name, told in events[:-1] if getattr(told, "index", None) == picture.index]
        progress = [told.written for _, told in own if isinstance(told, CodesWritten)]
        assert progress == sorted(set(progress))
        # Row by row; guesses that are right may bring more than one.
        assert set(progress) <= set(range(14, 99, 14))
        assert progress[-1] == 98
        assert [name for name, _ in own] == [
            "perception",
            "prediction",
            *["codes"] * len(progress),
            "picture",
        ]
        parts = {name: told.model_dump() for name, told in own}
        seen = picture.perception.model_dump(exclude={"objects": {"__all__": {"near_s"}}})
        assert parts["perception"]["perception"] == seen
        assert parts["prediction"]["prediction"] == picture.prediction.model_dump()
        assert parts["picture"] == picture.model_dump(include={"index", "image", "codes"})


def test_a_stream_is_told_before_the_answer_is_there(served: Served[TorchEngine]) -> None:
    async def stream() -> list[str]:
        request = imagine_request(scene(), "front_left", ImagineControls(n=1, seed=3))
        async with AsyncPlannerClient(served.url) as planner:
            return [name async for name, _ in planner.stream_imagine(request)]

    names = asyncio.run(stream())
    # Without guesses, as this camera is not in the scene, every row is told.
    assert names == ["perception", "prediction", *["codes"] * 7, "picture", "done"]


def test_what_cannot_be_streamed_gets_a_status(served: Served[TorchEngine]) -> None:
    problem(served.http.post(PATH, json=asked(camera="rear", stream=True)), "unknown-camera")
    history = [[0.0] * 4] * 15 + [[9.0] * 4]
    changed = asked(stream=True)["scene"] | {"history": history}
    problem(served.http.post(PATH, json=asked(stream=True, scene=changed)), "invalid-history")


def test_leaving_a_stream_ends_the_work() -> None:
    engine = ScriptedEngine()
    engine.card_shown = replace(CARD, formats=("cf_vla", "vla_world"), paints=True)
    with serve(engine, Settings()) as served:
        served.in_loop(engine.may_finish.clear)
        with served.http.stream("POST", PATH, json=asked(stream=True)) as answer:
            assert answer.status_code == 200
            assert served.metric("looktwice_plans_in_flight") == 1
        served.until(lambda: len(engine.cancelled) == 1)
        served.until(lambda: served.metric("looktwice_plans_in_flight") == 0)
        served.in_loop(engine.may_finish.set)
        engine.failure_later = EngineError("broke on the way")
        with pytest.raises(ServiceBusy, match="the log has why"):
            events_of(served)


def test_plans_imagine_as_the_caller_decides(served: Served[TorchEngine]) -> None:
    with PlannerClient(served.url) as planner:
        choices: dict[wire.Imagine, float] = {"always": 1.0, "never": 0.0}
        for imagine, share in choices.items():
            controls = wire.Controls(n=4, imagine=imagine, seed=2)
            draws = planner.plan(scene(), controls, format="vla_world").draws
            assert np.mean(["visual" in draw.tokens for draw in draws]) == share
            for draw in draws:
                own = {"perception", "prediction", "action"} | ({"visual"} if share else set())
                assert own <= set(draw.sections)
                if share:
                    codes, camera = draw.sections["visual"]
                    assert isinstance(codes, list)
                    # Nobody asks for a camera, so each code stands behind that of a blank picture.
                    assert codes[::2] == list(BLANK)
                    assert len(codes) == 2 * 98
                    assert str(camera).startswith("CAM_")
        with pytest.raises(RequestRefused, match="camera has no meaning with imagine: never") as caught:
            planner.plan(scene(), wire.Controls(imagine="never", camera="back"), format="vla_world")
        assert caught.value.errors[0].pointer == "/controls"
        for name, value in (("imagine", "never"), ("camera", "back")):
            with pytest.raises(RequestRefused, match="traj_only imagines no pictures") as caught:
                planner.plan(scene(), wire.Controls.model_validate({name: value}), format="traj_only")
            assert caught.value.type.endswith("/cannot-imagine")
            assert caught.value.errors[0].pointer == f"/controls/{name}"


def test_unknown_cameras_are_refused_by_name(served: Served[TorchEngine]) -> None:
    told = problem(served.http.post(PATH, json=asked(camera="rear")), "unknown-camera")
    assert told.errors[0].pointer == "/camera"
    assert all(camera in told.errors[0].detail for camera in CAMERAS)
    told = problem(
        served.http.post("/v1/plan", json=body() | {"controls": {"camera": "rear"}}), "unknown-camera"
    )
    assert told.errors[0].pointer == "/controls/camera"
    document = asked()
    del document["camera"]
    assert problem(served.http.post(PATH, json=document), "invalid-request").errors[0].pointer == "/camera"
    problem(served.http.post(PATH, json=asked(controls={"n": 65})), "invalid-controls")


def test_a_motion_is_predicted_and_one_that_nobody_makes_is_refused(served: Served[TorchEngine]) -> None:
    future = np.zeros((64, 4), np.float32)
    future[:, 0], future[:, 1], future[:, 3] = np.arange(1, 65), 0.1 * np.arange(1, 65), 0.02
    controls = ImagineControls(n=2, seed=1)
    free = imagine_request(scene(), "back", controls)
    motion = wire.Motion(x_m=5.0, y_m=0.5, heading_rad=0.02)
    told = imagined(served, free.model_copy(update={"motion": motion}).model_dump())
    assert [(each.prediction.x_m, each.prediction.y_m) for each in told.pictures] == [(5.0, 0.5)] * 2
    assert imagined(served, free.model_dump()).pictures != told.pictures
    for times_s in (TEN_HZ_S, TEN_HZ_S[1::3]):
        driven = at_times(future, TEN_HZ_S, times_s)
        request = imagine_request(scene(), "back", controls, trajectory=driven, times_s=times_s)
        assert imagined(served, request.model_dump()).pictures == told.pictures
    far = problem(served.http.post(PATH, json=asked(motion={"x_m": 41.0})), "invalid-controls")
    assert far.errors[0].pointer == "/motion"
    assert "nobody comes to (41.0, 0.0) m" in far.errors[0].detail
    endless = problem(served.http.post(PATH, json=asked(motion={"y_m": 1.0})), "invalid-request")
    assert endless.errors[0].pointer == "/motion/x_m"
    alone = body() | {"format": "vla_world", "controls": {"motion": {"x_m": 1.0}}}
    told_of = problem(served.http.post("/v1/plan", json=alone), "invalid-controls")
    assert "without the camera" in told_of.errors[0].detail


@pytest.mark.parametrize("format", ["traj_only", "vla_world"])
def test_a_draw_is_sent_back_as_it_is(served: Served[TorchEngine], format: str) -> None:
    draw = served.http.post("/v1/plan", json=body() | {"format": format}).json()["draws"][0]
    sent = asked(trajectory=draw["trajectory"], times_s=draw["times_s"])
    at_half = draw["trajectory"][4 if draw["times_s"] is None else draw["times_s"].index(0.5)]
    for picture in imagined(served, sent).pictures:
        # The language has steps of 0.1 m.
        assert (picture.prediction.x_m, picture.prediction.y_m) == pytest.approx(at_half[:2], abs=0.051)


POSES: list[list[float]] = [[1.0 * row, 0.0, 0.0, 0.0] for row in range(1, 65)]


def told_at(*times_s: float) -> dict[str, Any]:
    return {"trajectory": POSES[: len(times_s)], "times_s": times_s}


BEYOND = ("invalid-trajectory", "/trajectory", "beyond the horizon of a trajectory from ")
ASTRAY: list[tuple[str, dict[str, Any], str, str, str]] = [
    # what, fields, type, pointer, words
    ("it ends before", told_at(0.1, 0.4), *BEYOND),
    ("it begins after", told_at(0.6, 1.0), *BEYOND),
    ("times that do not ascend", told_at(1.0, 0.5), "invalid-trajectory", "/times_s", "must ascend"),
    ("a time that is past", told_at(0.0, 0.5), "invalid-trajectory", "/times_s/0", "greater than 0"),
    (
        "no times",
        {"trajectory": POSES, "times_s": []},
        "invalid-trajectory",
        "/trajectory",
        "times_s has 0",
    ),
    ("63 poses", {"trajectory": POSES[:63]}, "invalid-trajectory", "/trajectory", "63 poses are told"),
    (
        "poses for other times",
        {"trajectory": POSES[:3], "times_s": [0.5, 1.0]},
        "invalid-trajectory",
        "/trajectory",
        "times_s has 2",
    ),
    ("times of nothing", {"times_s": [0.5]}, "invalid-trajectory", "/times_s", "no trajectory"),
    ("no poses", {"trajectory": []}, "invalid-trajectory", "/trajectory", "at least 1"),
    ("words", {"trajectory": "straight on"}, "invalid-trajectory", "/trajectory", "valid list"),
    ("points", {"trajectory": [[1.0, 0.0]] * 64}, "invalid-trajectory", "/trajectory/0", "at least 4"),
    (
        "NaN",
        {"trajectory": [*POSES[:9], [float("nan")] * 4, *POSES[10:]]},
        "invalid-trajectory",
        "/trajectory/9/0",
        "finite",
    ),
    (
        "more than 40 m",
        {"trajectory": [[50.0, 0.0, 0.0, 0.0]], "times_s": [0.5]},
        "invalid-trajectory",
        "/trajectory",
        "nobody comes to (50.0, 0.0) m",
    ),
    (
        "farther than any",
        {"trajectory": [[1e300, 0.0, 0.0, 0.0]] * 64},
        "invalid-trajectory",
        "/trajectory",
        "not finite",
    ),
    (
        "a motion too",
        {"trajectory": POSES, "motion": {"x_m": 5.0}},
        "invalid-request",
        "/trajectory",
        "one of the two",
    ),
]


@pytest.mark.parametrize(
    ("fields", "slug", "pointer", "words"), [bad[1:] for bad in ASTRAY], ids=[bad[0] for bad in ASTRAY]
)
def test_a_trajectory_that_cannot_be_is_refused_by_name(
    served: Served[TorchEngine], fields: dict[str, Any], slug: str, pointer: str, words: str
) -> None:
    # Python's writer turns NaN into the literal that JSON does not have.
    content, headers = json.dumps(asked(**fields)), {"Content-Type": "application/json"}
    told = problem(served.http.post(PATH, content=content, headers=headers), slug)
    assert (told.status, told.errors[0].pointer) == (422, pointer)
    assert words in told.errors[0].detail
    streamed = json.dumps(asked(**fields, stream=True))
    problem(served.http.post(PATH, content=streamed, headers=headers), slug)


def test_models_that_cannot_imagine_or_paint_are_named() -> None:
    engine = ScriptedEngine()
    with serve(engine, Settings()) as served:
        told = problem(served.http.post(PATH, json=asked()), "cannot-imagine")
        assert "scripted writes cf_vla, traj_only" in told.detail
        engine.card_shown = replace(CARD, formats=("vla_world",))
        told = problem(served.http.post(PATH, json=asked()), "cannot-imagine")
        assert "no codes of pictures to paint with" in told.detail
        assert not engine.submitted
        engine.card_shown = replace(CARD, formats=("cf_vla", "vla_world"), paints=True)
        told_of = imagined(served, asked())
        assert len(told_of.pictures) == 2
        [request] = engine.submitted
        assert (request.format, request.controls.camera, request.controls.imagine) == (
            "vla_world",
            "front_left",
            "always",
        )
    with serve(NoModel(), Settings()) as served:
        problem(served.http.post(PATH, json=asked()), "unknown-format")


def test_a_checkpoint_without_codes_imagines_but_does_not_paint(checkpoint: Path, tmp_path: Path) -> None:
    loaded = load(checkpoint)
    save(tmp_path / "blind", loaded.model, loaded.vocabulary, loaded.codec)
    with serve(TorchEngine(tmp_path / "blind", TorchSettings(rows=2, products=None)), Settings()) as served:
        problem(served.http.post(PATH, json=asked()), "cannot-imagine")
        planned = {"format": "vla_world", "controls": {"n": 1, "imagine": "always"}}
        draws = served.http.post("/v1/plan", json=body() | planned).json()["draws"]
        assert draws[0]["tokens"]["visual"] > 98


def test_pictures_take_places_and_are_counted_as_draws_are(served: Served[TorchEngine]) -> None:
    before = served.metric("looktwice_requests_total", endpoint=PATH, status="200")
    with ThreadPoolExecutor(4) as pool:
        told = list(
            pool.map(
                lambda seed: imagined(served, asked(controls={"seed": seed, "codes": "drawn"})), range(4)
            )
        )
    assert len({each.pictures[0].codes[0] for each in told}) > 1
    assert served.metric("looktwice_requests_total", endpoint=PATH, status="200") == before + 4


def test_the_described_example_is_served(served: Served[TorchEngine]) -> None:
    described = served.http.get("/openapi.json").json()["paths"][PATH]["post"]
    content = described["requestBody"]["content"]["application/json"]
    for example in content["examples"].values():
        assert ImagineRequest.model_validate_json(json.dumps(example["value"]))
        assert events_of(served, **example["value"])[-1][0] == "done"
