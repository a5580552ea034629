"""From the wire's request to the engine's: everything is checked here, before the engine hears of it."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

import looktwice.clients.wire as wire
from looktwice.clients.wire_values import plan_of_tracks
from looktwice.model.driving.images import ImageError, check_image
from looktwice.model.driving.next_view import Motion
from looktwice.model.driving.plan import Plan, PlanError, parse_plan
from looktwice.model.driving.scene import Clip, Scene, SceneError, Track
from looktwice.model.driving.trajectory import (
    TEN_HZ_S,
    FloatArray,
    GeometryError,
    check_history,
    check_route,
    check_trajectory,
    wrap_angle,
)
from looktwice.model.engines.engine import Controls, PlanRequest, RequestError
from looktwice.model.families.family import Attempt
from looktwice.model.families.registry import family_named
from looktwice.model.network.model_card import ModelCard
from looktwice.service.problems import (
    CANNOT_IMAGINE,
    INVALID_ATTEMPT,
    INVALID_CLIP,
    INVALID_CONTROLS,
    INVALID_HISTORY,
    INVALID_IMAGE,
    INVALID_PLAN,
    INVALID_ROUTE,
    INVALID_TRACKS,
    MISSING_CAMERA,
    UNKNOWN_FORMAT,
    at,
)

MAX_STEP_M: Final = 10.0
"""Between history rows: 100 m/s. Faster is another unit or another frame, not a car."""
MAX_STEP_CHANGE_M: Final = 1.0
"""Between neighbouring steps: 100 m/s². Rows out of order zigzag by more at any speed above 4 m/s."""
MAX_TURN_RAD: Final = 0.5
"""Between history rows: 290 degrees a second. More is a heading in degrees."""


@dataclass(frozen=True, eq=False)
class Geometry:
    """What a scene says in numbers, checked.

    Attributes:
        history: float32 [16, 4].
        route: float32 [20, 2]; None where it is unknown.
        tracks: None where nobody tracks.
    """

    history: FloatArray
    route: FloatArray | None
    tracks: tuple[Track, ...] | None


def engine_request(
    asked: wire.PlanRequest | wire.ReflectRequest,
    card: ModelCard,
    engine_id: str,
    geometry: Geometry | None = None,
) -> PlanRequest:
    """The engine's request for what was ``asked``; a plan to be reflected upon is the first one.

    Args:
        asked: a request whose shapes the schema has checked.
        card: the model that is to answer.
        engine_id: unique among running requests, which a caller's request id need not be.
        geometry: of its scene, where that is checked already.

    Raises:
        ProblemError: pictures, geometry, plan, attempt, controls, format or cameras that cannot be served.
    """
    format, attempt = format_of(asked, card), None
    if not card.formats:
        raise at(UNKNOWN_FORMAT, "/format", "this service runs without a model; it only scores")
    if format not in card.formats:
        raise at(UNKNOWN_FORMAT, "/format", f"{card.name} writes {', '.join(card.formats)}")
    cameras = [clip.camera for clip in asked.scene.clips]
    if missing := [camera for camera in card.cameras if camera not in cameras]:
        raise at(MISSING_CAMERA, "/scene/clips", f"{card.name} also needs {', '.join(missing)}")
    if asked.scene.tracks is not None and "tracks" not in card.inputs:
        raise at(INVALID_TRACKS, "/scene/tracks", f"{card.name} takes none; leave them out")
    _check_thinking(asked.controls, format)
    if isinstance(asked, wire.ReflectRequest):
        controls = _controls(asked.controls, plan_of(asked.plan, "/plan"))
    else:
        _check_imagining(asked.controls, format)
        given = asked.controls.prefill
        prefill = None if given is None else plan_of(given, "/controls/prefill")
        controls = _controls(asked.controls, prefill)
        attempt = _attempt(asked.attempt, format)
    scene = scene_of(asked.scene, geometry)
    return PlanRequest(engine_id, scene, format, controls, attempt, live=asked.stream)


def format_of(asked: wire.PlanRequest | wire.ReflectRequest, card: ModelCard) -> str:
    """The response format of what was ``asked``: the model's first where none is named."""
    return card.default_format if asked.format is None else asked.format


def _check_thinking(asked: wire.ReflectControls, format: str) -> None:
    """Raise `ProblemError` where a choice to think is made that a format cannot follow."""
    family = family_named(format)
    if refused := family.thinking_refused(asked.thinking):
        raise at(INVALID_CONTROLS, "/controls/thinking", refused)
    if asked.think_threshold is not None and family.branch is None:
        problem = f"{format} has no branch for it to decide; leave it out"
        raise at(INVALID_CONTROLS, "/controls/think_threshold", problem)


def _check_imagining(asked: wire.Controls, format: str) -> None:
    """Raise `ProblemError` where a choice to imagine is made for a format that cannot."""
    if family_named(format).imagination is not None:
        return
    for name, left_open in (("imagine", "auto"), ("camera", None), ("motion", None), ("imagine_once", False)):
        if getattr(asked, name) != left_open:
            raise at(CANNOT_IMAGINE, f"/controls/{name}", f"{format} imagines no pictures; leave it out")


def _attempt(asked: wire.Attempt | None, format: str) -> Attempt | None:
    """What the format refines; raises `ProblemError` where it needs one, takes none, or has other times."""
    family, pointer = family_named(format), "/attempt"
    if asked is None:
        if family.refines:
            raise at(
                INVALID_ATTEMPT,
                pointer,
                f"{format} refines an attempt, and there is none: send a draft and feedback on it",
            )
        return None
    if not family.refines:
        raise at(INVALID_ATTEMPT, pointer, f"{format} refines none; leave it out")
    if tuple(asked.times_s or TEN_HZ_S) != family.times_s:
        times = ", ".join(f"{time_s:g}" for time_s in family.times_s)
        raise at(INVALID_ATTEMPT, f"{pointer}/times_s", f"{format} refines poses at {times} s")
    try:
        return Attempt(check_trajectory(asked.trajectory, family.times_s), asked.feedback)
    except GeometryError as error:
        raise at(INVALID_ATTEMPT, f"{pointer}/trajectory", str(error)) from None


def geometry_of(asked: wire.Scene) -> Geometry:
    """What a scene says in numbers; raises `ProblemError` for what cannot be."""
    return Geometry(_history_of(asked), _route_of(asked), _tracks_of(asked))


def scene_of(asked: wire.Scene, geometry: Geometry | None = None) -> Scene:
    """A scene.

    Args:
        asked: whose shapes the schema has checked.
        geometry: of it, where that is checked already.

    Raises:
        ProblemError: pictures and geometry that cannot be accepted.
    """
    known = geometry or geometry_of(asked)
    clips = tuple(
        Clip(clip.camera, tuple(_images(clip.images, f"/scene/clips/{number}/images")))
        for number, clip in enumerate(asked.clips)
    )
    try:
        return Scene(asked.scene_id, clips, known.history, known.route, known.tracks)
    except SceneError as error:
        raise at(INVALID_CLIP, "/scene/clips", str(error)) from None


def _tracks_of(asked: wire.Scene) -> tuple[Track, ...] | None:
    """Its tracks; raises `ProblemError` for one that cannot be."""
    return None if asked.tracks is None else tuple(map(_track, range(len(asked.tracks)), asked.tracks))


def _route_of(asked: wire.Scene) -> FloatArray | None:
    """Its route; raises `ProblemError` for one that leads nowhere."""
    try:
        return None if asked.route is None else check_route(asked.route)
    except GeometryError as error:
        raise at(INVALID_ROUTE, "/scene/route", str(error)) from None


def _track(number: int, asked: wire.Track) -> Track:
    try:
        return Track(**asked.model_dump(exclude={"lights"}), lights=frozenset(asked.lights))
    except SceneError as error:
        raise at(INVALID_TRACKS, f"/scene/tracks/{number}", str(error)) from None


def _images(given: Iterable[str | bytes], pointer: str) -> Iterable[bytes]:
    for number, each in enumerate(given):
        try:
            image = each if isinstance(each, bytes) else base64.b64decode(each, validate=True)
            check_image(image)
        except (ImageError, binascii.Error, ValueError) as error:
            problem = str(error) if isinstance(error, ImageError) else f"not base64: {error}"
            raise at(INVALID_IMAGE, f"{pointer}/{number}", problem) from None
        yield image


def _history_of(asked: wire.Scene) -> FloatArray:
    """Its history; raises `ProblemError` for one that no car can have driven."""
    pointer = "/scene/history"
    try:
        history = check_history(asked.history)
    except GeometryError as error:
        raise at(INVALID_HISTORY, pointer, str(error)) from None
    steps = np.diff(history[:, :3], axis=0)
    _limit(np.linalg.norm(steps, axis=1), MAX_STEP_M, "moves {:.1f} m in 0.1 s; is it 10 Hz and metres?")
    _limit(
        np.linalg.norm(np.diff(steps, axis=0), axis=1),
        MAX_STEP_CHANGE_M,
        "changes its step by {:.1f} m in 0.1 s; are the rows in order of time, oldest first, at 10 Hz?",
    )
    turns = np.abs(wrap_angle(np.diff(history[:, 3])))
    _limit(turns, MAX_TURN_RAD, "turns by {:.1f} rad in 0.1 s; are headings in radians?")
    return history


def _limit(values: np.ndarray[tuple[int, ...], np.dtype[np.floating]], largest: float, text: str) -> None:
    worst = int(values.argmax())
    if values[worst] > largest:
        problem = text.format(float(values[worst]))
        raise at(INVALID_HISTORY, f"/scene/history/{worst + 1}", f"the ego {problem}")


def _controls(asked: wire.ReflectControls, prefill: Plan | None) -> Controls:
    imagining = asked if isinstance(asked, wire.Controls) else wire.Controls()
    motion = imagining.motion
    try:
        return Controls(
            thinking=asked.thinking,
            think_threshold=asked.think_threshold,
            prefill=prefill,
            n=asked.n,
            temperature=asked.temperature,
            top_p=asked.top_p,
            seed=asked.seed,
            deadline_ms=asked.deadline_ms,
            numbers=asked.numbers,
            codes=asked.codes,
            bind=asked.bind,
            reasons=asked.reasons,
            logprobs=asked.logprobs,
            imagine=imagining.imagine,
            camera=imagining.camera,
            motion=None if motion is None else Motion(motion.x_m, motion.y_m, motion.heading_rad),
            imagine_once=imagining.imagine_once,
        )
    except (RequestError, GeometryError) as error:
        raise at(INVALID_CONTROLS, "/controls", str(error)) from None


def plan_of(asked: wire.PlanGiven, pointer: str) -> Plan:
    """A given plan; raises `ProblemError` where it breaks the plan language."""
    try:
        return parse_plan(asked) if isinstance(asked, str) else plan_of_tracks(asked)
    except PlanError as error:
        raise at(INVALID_PLAN, pointer, str(error), error.line, error.column) from None
