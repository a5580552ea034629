"""Imagining of a camera's picture, from the parsed body to the answer."""

from __future__ import annotations

import base64
import time
from dataclasses import dataclass

import clients.wire as wire
import clients.wire_imagine as wire_imagine
from model.driving.images import encode_png
from model.engines.engine import Draw, ModelCard
from model.families.family import Imagination
from model.families.registry import family_named
from service.planning import Arrival, Planned
from service.problems import CANNOT_IMAGINE, UNKNOWN_FORMAT, ProblemError

_DECIMALS = 4


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
    """What a request comes to; raises `ProblemError` for a model that cannot imagine, or cannot paint."""
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
            **dict(asked.controls), thinking="adaptive", imagine="always", camera=asked.camera, logprobs=True
        ),
        format=format,
    )
    return Imagining(format, imagination, asked.camera, planning)


def imagine_answer(imagining: Imagining, planned: Planned, arrival: Arrival) -> wire_imagine.ImagineResponse:
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


def _picture(imagination: Imagination, planned: Planned, draw: Draw) -> wire_imagine.ImaginedPicture:
    foreseen = draw.foreseen
    assert foreseen is not None
    assert foreseen.picture is not None, "a picture was asked for"
    perceived, codes = foreseen.perceived, list(foreseen.picture.codes)
    return wire_imagine.ImaginedPicture(
        index=draw.index,
        image=base64.b64encode(encode_png(planned.paint(codes))).decode(),
        codes=codes,
        # Above 0 by rounding alone.
        logprob=min(0.0, draw.section_logprobs[imagination.section]),
        perception=wire_imagine.Perception(
            objects=[
                wire_imagine.PerceivedObject(
                    kind=agent.kind,
                    x_m=round(agent.x_m, _DECIMALS),
                    y_m=round(agent.y_m, _DECIMALS),
                    length_m=agent.length_m,
                    width_m=agent.width_m,
                    near_s=agent.near_s,
                )
                for agent in perceived.agents
            ],
            left_m=perceived.left_m,
            right_m=perceived.right_m,
        ),
        prediction=wire_imagine.Prediction(
            x_m=round(foreseen.x_m, _DECIMALS),
            y_m=round(foreseen.y_m, _DECIMALS),
            direction=foreseen.direction,
        ),
    )
