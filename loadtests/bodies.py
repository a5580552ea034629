"""Request bodies, written before a run begins: while it runs, only bytes are sent."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Final, cast

import httpx
import msgpack

from looktwice.clients import wire
from looktwice.clients.planner import imagine_request, label_request, plan_request, reflect_request
from looktwice.clients.wire_imagine import ImagineControls
from looktwice.loadtests.exchange import Call
from looktwice.loadtests.mix import BATCH_SCENES, Mix, Payload, RequestKind, Work
from looktwice.model.driving.images import media_type
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.plan import Plan, parse_plan
from looktwice.model.driving.scene import CLIP_FRAMES, CLIP_PERIOD_S, Clip, LabelledScene, Scene
from looktwice.model.driving.trajectory import STEP_S
from looktwice.model.driving.variations import fresh, moved
from looktwice.model.driving.view import Surroundings

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


def make_calls(scenes: Sequence[LabelledScene], kinds: Sequence[RequestKind], seed: int) -> list[Call]:
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


def make_call(kind: RequestKind, scenes: Sequence[LabelledScene], seed: int) -> Call:
    """A call of ``kind`` for one scene, or for those of a batch; draws are those of ``seed``."""
    asked = [_asked(kind, labelled, seed) for labelled in scenes]
    document: dict[str, Any] = {"requests": asked} if kind.work == "batch" else asked[0]
    if kind.stream:
        document["stream"] = True
    media, body = _WRITE[kind.payload](document, scenes)
    accept = "text/event-stream" if kind.stream else "application/json"
    return Call(kind, PATHS[kind.work], (("Content-Type", media), ("Accept", accept)), body)


def _asked(kind: RequestKind, labelled: LabelledScene, seed: int) -> dict[str, Any]:
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


def make_drives(
    scenes: Sequence[LabelledScene], mix: Mix, planners: int, hz: float, seconds: float, seed: int
) -> list[list[Call]]:
    """The calls of each planner; every planner asks for one kind of request throughout.

    Raises:
        ValueError: there are no scenes, or ``hz`` does not divide 10.
    """
    if not scenes:
        raise ValueError("a fleet needs scenes to drive through")
    drives = []
    for planner, kind in enumerate(mix.kinds(planners, seed)):
        labelled = scenes[planner % len(scenes)]
        seen = drive(labelled.scene, (seed * planners + planner) * 1_000_003, hz, seconds)
        drives.append([make_call(kind, [replace(labelled, scene=scene)], planner) for scene in seen])
    return drives


def drive(scene: Scene, number: int, hz: float, seconds: float) -> list[Scene]:
    """Scenes of a car that drives on from ``scene``, one for each tick.

    The ego history moves on at every tick. Cameras are slower: every 0.5 s a clip loses its oldest picture
    and gets a new one, so scenes within half a second share all pictures and then three of four.

    Args:
        scene: where it begins.
        number: tells the pictures of one drive from those of all others.
        hz: ticks per second, a divisor of 10.
        seconds: how long.

    Raises:
        ValueError: histories, which are at 10 Hz, cannot move on at ``hz``.
    """
    steps = round(1 / (hz * STEP_S))
    if steps < 1 or abs(steps * hz * STEP_S - 1) > 1e-9:
        raise ValueError(f"planners ask at 10, 5, 2 or 1 Hz, in step with their histories; not at {hz:g} Hz")
    ticks = round(seconds * hz)
    slides = int(ticks / hz / CLIP_PERIOD_S) + 1
    rolls = _rolls(scene, number, CLIP_FRAMES + slides)
    driven, position = [], scene
    for tick in range(ticks):
        slide = int(tick / hz / CLIP_PERIOD_S + 1e-9)
        clips = tuple(Clip(camera, roll[slide : slide + CLIP_FRAMES]) for camera, roll in rolls.items())
        driven.append(replace(position, scene_id=f"{scene.scene_id}-{number}-{tick}", clips=clips))
        position = moved(position, steps)
    return driven


def _rolls(scene: Scene, number: int, pictures: int) -> dict[str, tuple[bytes, ...]]:
    """So many pictures of every camera, no two alike: the scene's own, over and over, each time new."""
    rounds = [fresh(scene, number + turn) for turn in range(-(-pictures // CLIP_FRAMES))]
    return {
        clip.camera: tuple(image for turn in rounds for image in turn.clip(clip.camera).images)[:pictures]
        for clip in scene.clips
    }
