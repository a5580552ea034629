from __future__ import annotations

import base64
from typing import Any

import pytest

from looktwice.clients import wire
from looktwice.clients.wire_imagine import ImagineRequest
from looktwice.loadtests.bodies import make_call, make_calls
from looktwice.loadtests.mix import BATCH_SCENES, Mix, Payload, RequestKind, Work
from tests.loadtests.scenes import labelled_scenes
from tests.loadtests.stand_in import parsed

ONE = labelled_scenes()[:1]


def asked(kind: RequestKind, scenes: int = 1) -> dict[str, Any]:
    call = make_call(kind, labelled_scenes()[:scenes], seed=3)
    return parsed(dict(call.headers)["Content-Type"], call.body)


def test_a_json_body_is_what_the_contract_asks_for() -> None:
    plan = make_call(RequestKind("think", 4, deadline_ms=300), ONE, seed=3)
    controls = wire.PlanRequest.model_validate_json(plan.body).controls
    assert (controls.n, controls.thinking, controls.deadline_ms, controls.seed) == (4, "always", 300, 3)
    wire.ReflectRequest.model_validate_json(make_call(RequestKind("reflect"), ONE, 3).body)
    wire.LabelRequest.model_validate_json(make_call(RequestKind("label", 1), ONE, 3).body)
    imagine = ImagineRequest.model_validate_json(
        make_call(RequestKind("imagine", 2, stream=True), ONE, 3).body
    )
    assert (imagine.controls.n, imagine.controls.seed, imagine.stream) == (2, 3, True)
    assert imagine.camera in {clip.camera for clip in ONE[0].scene.clips}


@pytest.mark.parametrize(
    ("work", "thinking"), [("plan", "adaptive"), ("direct", "never"), ("think", "always")]
)
def test_who_decides_on_thinking(work: Work, thinking: str) -> None:
    assert asked(RequestKind(work))["controls"]["thinking"] == thinking


@pytest.mark.parametrize("payload", ["msgpack", "multipart"])
@pytest.mark.parametrize("work", ["plan", "reflect", "batch", "imagine"])
def test_other_payloads_say_the_same_with_pictures_as_they_are(work: Work, payload: Payload) -> None:
    scenes = BATCH_SCENES if work == "batch" else 1
    plain, other = asked(RequestKind(work), scenes), asked(RequestKind(work, payload=payload), scenes)
    for one in plain.get("requests", [plain]):
        for clip in one["scene"]["clips"]:
            clip["images"] = [base64.b64decode(image) for image in clip["images"]]
    assert other == plain


def test_streams_are_asked_for_at_the_top() -> None:
    assert asked(RequestKind(stream=True))["stream"] is True
    assert asked(RequestKind())["stream"] is False


def test_no_two_calls_share_a_picture() -> None:
    mix = Mix(payloads={"msgpack": 1}, works={"plan": 3, "batch": 1})
    calls, again = (make_calls(labelled_scenes()[:2], mix.kinds(12, seed=7), seed=7) for _ in range(2))
    assert [call.body for call in calls] == [call.body for call in again]
    pictures = [
        picture
        for call in calls
        for content in [parsed("application/msgpack", call.body)]
        for one in content.get("requests", [content])
        for clip in one["scene"]["clips"]
        for picture in clip["images"]
    ]
    assert len(set(pictures)) == len(pictures)


def test_without_scenes_there_is_nothing_to_send() -> None:
    with pytest.raises(ValueError, match="scenes"):
        make_calls([], Mix().kinds(3, 0), 0)
