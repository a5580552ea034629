"""Imagining of a camera's picture, from the parsed body to the answer."""

from __future__ import annotations

import asyncio
import base64
import time
from collections.abc import Sequence
from dataclasses import dataclass

import looktwice.clients.wire as wire
import looktwice.clients.wire_imagine as wire_imagine
from looktwice.model.driving.images import encode_png
from looktwice.model.driving.next_view import Motion, motion_along
from looktwice.model.driving.perceived import Perceived, PerceivedAgent
from looktwice.model.driving.trajectory import TEN_HZ_S, GeometryError, check_times
from looktwice.model.engines.engine import CodesWritten, Draw, SectionFinished
from looktwice.model.families.family import Imagination, Predicted
from looktwice.model.families.registry import family_named
from looktwice.model.network.model_card import ModelCard
from looktwice.service.planning.events import Arrival, Begun, Paint, PlannedScene, SceneEvent
from looktwice.service.problems import (
    CANNOT_IMAGINE,
    INVALID_CONTROLS,
    INVALID_REQUEST,
    INVALID_TRAJECTORY,
    UNKNOWN_FORMAT,
    ProblemError,
    at,
)

_DECIMALS = 4

Written = (
    wire_imagine.PerceptionWritten
    | wire_imagine.PredictionWritten
    | wire_imagine.CodesWritten
    | wire_imagine.Picture
)
"""The data of an event."""


@dataclass(frozen=True)
class Imagining:
    """A picture that is to be imagined.

    Attributes:
        format: that imagines it.
        imagination: of its family.
        camera: whose picture it is.
        planning: what the engine is asked.
    """

    format: str
    imagination: Imagination
    camera: wire.Camera
    planning: wire.PlanRequest


def imagining_of(asked: wire_imagine.ImagineRequest, card: ModelCard) -> Imagining:
    """What a request comes to.

    Raises:
        ProblemError: a model that cannot imagine, or cannot paint; a motion or a trajectory that cannot be.
    """
    if not card.formats:
        raise ProblemError(UNKNOWN_FORMAT, "this service runs without a model; it only scores")
    for format in card.formats:
        imagination = family_named(format).imagination
        if imagination is not None:
            break
    else:
        written = ", ".join(card.formats)
        raise ProblemError(CANNOT_IMAGINE, f"{card.name} writes {written}, and imagines in none of these")
    if not card.paints:
        raise ProblemError(
            CANNOT_IMAGINE, f"{card.name} imagines in {format}, but has no codes of pictures to paint with"
        )
    planning = wire.PlanRequest(
        scene=asked.scene,
        controls=wire.Controls(
            **dict(asked.controls),
            thinking="adaptive",
            imagine="always",
            camera=asked.camera,
            motion=_motion(asked),
            logprobs=True,
        ),
        format=format,
        stream=asked.stream,
    )
    return Imagining(format, imagination, asked.camera, planning)


def _motion(asked: wire_imagine.ImagineRequest) -> wire.Motion | None:
    """What the ego is to do in half a second; raises `ProblemError` for what cannot be."""
    if asked.trajectory is None:
        if asked.times_s is not None:
            raise at(INVALID_TRAJECTORY, "/times_s", "there is no trajectory; leave them out, or send one")
        if asked.motion is not None:
            try:
                Motion(**dict(asked.motion))
            except GeometryError as error:
                raise at(INVALID_CONTROLS, "/motion", str(error)) from None
        return asked.motion
    if asked.motion is not None:
        raise at(INVALID_REQUEST, "/trajectory", "there is a motion too; send one of the two")
    times_s = TEN_HZ_S if asked.times_s is None else tuple(asked.times_s)
    if len(asked.trajectory) != len(times_s):
        of = "times_s has" if asked.times_s is not None else "10 Hz without times_s are"
        poses = f"{len(asked.trajectory)} poses are told"
        raise at(INVALID_TRAJECTORY, "/trajectory", f"{poses}, and {of} {len(times_s)}")
    try:
        check_times(times_s)
    except GeometryError:
        raise at(INVALID_TRAJECTORY, "/times_s", "must ascend") from None
    try:
        motion = motion_along(asked.trajectory, times_s)
    except GeometryError as error:
        raise at(INVALID_TRAJECTORY, "/trajectory", str(error)) from None
    return wire.Motion(x_m=motion.x_m, y_m=motion.y_m, heading_rad=motion.heading_rad)


def imagine_answer(
    imagining: Imagining, planned: PlannedScene, arrival: Arrival
) -> wire_imagine.ImagineResponse:
    """The answer of POST /v1/imagine; pictures are painted here, which takes some ms each."""
    pictures = [_picture(imagining.imagination, planned, draw) for draw in planned.draws]
    total_ms = round(1000 * (time.monotonic() - arrival.since_s), 2)
    return wire_imagine.ImagineResponse(
        request_id=arrival.request_id,
        model=wire.ModelName(name=planned.card.name, revision=planned.card.revision),
        format=imagining.format,
        camera=imagining.camera,
        seconds=wire_imagine.SECONDS_AHEAD,
        pictures=pictures,
        timing=planned.timing.model_copy(update={"total_ms": total_ms}),
    )


class ImagineTeller:
    """Tells of pictures that are being written.

    Args:
        imagination: of the family that writes them.
    """

    def __init__(self, imagination: Imagination) -> None:
        self._imagination = imagination
        self._paint: Paint | None = None
        self._rows: dict[int, int] = {}

    async def __call__(self, event: SceneEvent) -> list[tuple[str, Written]]:
        """Events of `looktwice.clients.wire_imagine.EVENTS` with their data."""
        imagination = self._imagination
        match event:
            case Begun(paint):
                self._paint = paint
            case SectionFinished(index, section, _, values) if section == imagination.perception:
                seen = _seen(imagination.perceived(values))
                return [("perception", wire_imagine.PerceptionWritten(index=index, perception=seen))]
            case SectionFinished(index, section, _, values) if section == imagination.prediction:
                prediction = _prediction(imagination.predicted(values))
                return [("prediction", wire_imagine.PredictionWritten(index=index, prediction=prediction))]
            case CodesWritten(index, section, count) if section == imagination.section:
                return self._progress(index, count)
            case SectionFinished(index, section, _, values) if section == imagination.section:
                codes = imagination.pictured(values).codes
                assert self._paint is not None, "an engine begins before it writes"
                # On a thread: painting must not hold up the answers of others.
                image = await asyncio.to_thread(_png, self._paint, codes)
                picture = wire_imagine.Picture(index=index, image=image, codes=list(codes))
                return [*self._progress(index, len(codes)), ("picture", picture)]
        return []

    def _progress(self, index: int, count: int) -> list[tuple[str, Written]]:
        """Told when further rows are whole."""
        rows = count // wire_imagine.ROW_CODES
        if rows <= self._rows.get(index, 0):
            return []
        self._rows[index] = rows
        written = rows * wire_imagine.ROW_CODES
        return [("codes", wire_imagine.CodesWritten(index=index, written=written))]


def _png(paint: Paint, codes: Sequence[int]) -> str:
    """A picture in base64; takes some ms."""
    return base64.b64encode(encode_png(paint(codes))).decode()


def _picture(imagination: Imagination, planned: PlannedScene, draw: Draw) -> wire_imagine.ImaginedPicture:
    foreseen = draw.foreseen
    assert foreseen is not None
    assert foreseen.picture is not None, "a picture was asked for"
    perceived, codes = foreseen.perceived, list(foreseen.picture.codes)
    return wire_imagine.ImaginedPicture(
        index=draw.index,
        image=_png(planned.paint, codes),
        codes=codes,
        # Above 0 by rounding alone.
        logprob=min(0.0, draw.section_logprobs[imagination.section]),
        perception=wire_imagine.Perception(
            objects=[
                wire_imagine.PerceivedObject(**dict(_object(agent)), near_s=agent.near_s)
                for agent in perceived.agents
            ],
            left_m=perceived.left_m,
            right_m=perceived.right_m,
        ),
        prediction=_prediction(Predicted(foreseen.x_m, foreseen.y_m, foreseen.direction)),
    )


def _seen(perceived: Perceived) -> wire_imagine.Seen:
    return wire_imagine.Seen(
        objects=list(map(_object, perceived.agents)), left_m=perceived.left_m, right_m=perceived.right_m
    )


def _object(agent: PerceivedAgent) -> wire_imagine.SeenObject:
    return wire_imagine.SeenObject(
        kind=agent.kind,
        x_m=round(agent.x_m, _DECIMALS),
        y_m=round(agent.y_m, _DECIMALS),
        length_m=agent.length_m,
        width_m=agent.width_m,
    )


def _prediction(predicted: Predicted) -> wire_imagine.Prediction:
    return wire_imagine.Prediction(
        x_m=round(predicted.x_m, _DECIMALS),
        y_m=round(predicted.y_m, _DECIMALS),
        direction=predicted.direction,
    )
