"""Request bodies, written before a run begins: while it runs, only bytes are sent."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Final, cast

import httpx
import msgpack

from clients import wire
from clients.planner import imagine_request, label_request, plan_request, reflect_request
from clients.wire_imagine import ImagineControls
from loadtests.call import Call
from loadtests.mix import BATCH_SCENES, Kind, Payload, Work
from model.driving.images import media_type
from model.driving.labeller import expert_plan
from model.driving.plan import Plan, parse_plan
from model.driving.scene import LabelledScene
from model.driving.variations import fresh
from model.driving.view import Surroundings

PATHS: Final[dict[Work, str]] = {
    "plan": "/v1/plan",
    "direct": "/v1/plan",
    "think": "/v1/plan",
    "reflect": "/v1/reflect",
    "label": "/v1/label",
    "batch": "/v1/plan/batch",
    "imagine": "/v1/imagine",
}
THINKING: Final[dict[Work, wire.Thinking]] = {"direct": "never", "think": "always"}
PROPOSED: Final[Plan] = parse_plan(
    "- longitudinal\n  - 0.0s-6.4s: Keep Speed\n"
    "- lateral\n  - 0.0s-6.4s: Straight\n"
    "- lane\n  - 0.0s-6.4s: Keep Lane\n"
)
"""What reflections and labels are asked about: to go straight on."""


def make_calls(scenes: Sequence[LabelledScene], kinds: Sequence[Kind], seed: int) -> list[Call]:
    """A call of each kind, with pictures that no other one has: no cache of the service helps.

    Raises:
        ValueError: there are no scenes.
    """
    if not scenes:
        raise ValueError("a load needs scenes to be sent")
    numbers = itertools.count(seed * 1_000_003)

    def unseen() -> LabelledScene:
        number = next(numbers)
        labelled = scenes[number % len(scenes)]
        return replace(labelled, scene=fresh(labelled.scene, number))

    return [
        make_call(kind, [unseen() for _ in range(BATCH_SCENES if kind.work == "batch" else 1)], place)
        for place, kind in enumerate(kinds)
    ]


def make_call(kind: Kind, scenes: Sequence[LabelledScene], seed: int) -> Call:
    """A call of ``kind`` for one scene, or for those of a batch; draws are those of ``seed``."""
    asked = [_asked(kind, labelled, seed) for labelled in scenes]
    document: dict[str, Any] = {"requests": asked} if kind.work == "batch" else asked[0]
    if kind.stream:
        document["stream"] = True
    media, body = _WRITE[kind.payload](document, scenes)
    accept = "text/event-stream" if kind.stream else "application/json"
    return Call(kind, PATHS[kind.work], (("Content-Type", media), ("Accept", accept)), body)


def _asked(kind: Kind, labelled: LabelledScene, seed: int) -> dict[str, Any]:
    """The request with its pictures in base64."""
    scene = labelled.scene
    if kind.work == "label":
        asked = label_request(scene, PROPOSED, expert_plan(labelled), Surroundings.of(labelled), seed)
        return asked.model_dump(mode="json")
    if kind.work == "imagine":
        # In turn those that the scene shows, as a planner does that compares with what comes.
        camera = cast(wire.Camera, scene.clips[seed % len(scene.clips)].camera)
        controls = ImagineControls(n=kind.n, seed=seed)
        return imagine_request(scene, camera, controls).model_dump(mode="json")
    shared: dict[str, Any] = {"n": kind.n, "seed": seed, "deadline_ms": kind.deadline_ms}
    if kind.work == "reflect":
        return reflect_request(scene, PROPOSED, wire.ReflectControls(**shared)).model_dump(mode="json")
    planned = wire.Controls(thinking=THINKING.get(kind.work, "adaptive"), **shared)
    return plan_request(scene, planned).model_dump(mode="json")


def _json(document: dict[str, Any], scenes: Sequence[LabelledScene]) -> tuple[str, bytes]:
    return "application/json", json.dumps(document, separators=(",", ":")).encode()


def _msgpack(document: dict[str, Any], scenes: Sequence[LabelledScene]) -> tuple[str, bytes]:
    for clip, pictures in _clips(document, scenes):
        clip["images"] = list(pictures)
    return "application/msgpack", msgpack.packb(document)


def _multipart(document: dict[str, Any], scenes: Sequence[LabelledScene]) -> tuple[str, bytes]:
    files: list[tuple[str, tuple[str, bytes, str]]] = []
    for clip, pictures in _clips(document, scenes):
        names = [f"picture{len(files) + place}" for place in range(len(pictures))]
        clip["images"] = [f"cid:{name}" for name in names]
        files += [(name, (name, each, media_type(each))) for name, each in zip(names, pictures, strict=True)]
    described = ("request", (None, json.dumps(document, separators=(",", ":")), "application/json"))
    request = httpx.Request("POST", "http://service", files=[described, *files])
    return request.headers["Content-Type"], request.read()


def _clips(
    document: dict[str, Any], scenes: Sequence[LabelledScene]
) -> Iterator[tuple[dict[str, Any], tuple[bytes, ...]]]:
    """Every clip of a document, and its pictures as they are."""
    for asked, labelled in zip(document.get("requests", [document]), scenes, strict=True):
        for clip, given in zip(asked["scene"]["clips"], labelled.scene.clips, strict=True):
            yield clip, given.images


_WRITE: Final[dict[Payload, Callable[[dict[str, Any], Sequence[LabelledScene]], tuple[str, bytes]]]] = {
    "json": _json,
    "msgpack": _msgpack,
    "multipart": _multipart,
}
