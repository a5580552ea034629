"""What every engine does with a request before decoding, and with a response after it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import cast

from model.driving.plan import Plan
from model.engines.engine import Branch, Draw, ModelCard, PlanRequest, RequestError
from model.engines.response import Response
from model.families.cf_vla.format import ACTION, BRANCH, THINKING
from model.formats.cursor import CompiledFormat, Cursor
from model.formats.pieces import FormatError
from model.formats.text import parse
from model.network.codec import TrajectoryCodec
from model.network.vocabulary import Vocabulary


def begin(request: PlanRequest, card: ModelCard, formats: Mapping[str, CompiledFormat]) -> Cursor:
    """The cursor at which the response to a request begins.

    Raises:
        RequestError: it can never be served: an unknown format, a missing camera, or a prefill that the
            format cannot write.
    """
    if request.format not in formats:
        known = ", ".join(formats)
        raise RequestError(f"unknown format {request.format!r}; this checkpoint writes {known}")
    try:
        start = formats[request.format].start(_given(request))
    except FormatError as error:
        raise RequestError(f"prefill: {error}") from error
    cameras = {clip.camera for clip in request.scene.clips}
    if missing := [camera for camera in card.cameras if camera not in cameras]:
        raise RequestError(f"the scene lacks camera {', '.join(missing)}, which this checkpoint needs")
    return start


def _given(request: PlanRequest) -> dict[str, Plan]:
    """The plans that the caller gives, by section."""
    prefill = request.controls.prefill
    return {} if prefill is None else {"plan": prefill}


def branch_of(cursor: Cursor, token: int) -> Branch:
    """At the branch: where ``token`` leads."""
    return THINKING if THINKING in cursor.option_texts(token) else ACTION


def read(
    request: PlanRequest,
    response: Response,
    passes: int,
    draws: Iterable[int],
    vocabulary: Vocabulary,
    codec: TrajectoryCodec,
) -> list[Draw]:
    """The draws that wrote ``response``: all the same, but for their index.

    Raises:
        FormatError: the text is no response of the format.
    """
    text = vocabulary.decode([token.id for token in response.tokens])
    values = parse(response.cursor.compiled, text, _given(request))
    codes, branch, thinking = values["trajectory"], values.get(BRANCH), values.get("thinking")
    assert isinstance(codes, tuple)
    codes = cast("tuple[int, ...]", codes)
    plan, revised = values.get("plan"), values.get("revised_plan")
    trajectory = codec.decode(request.scene.history[None], [codes])[0]
    counts = dict(Counter(token.section for token in response.tokens))
    return [
        Draw(
            index=index,
            text=text,
            plan=plan if isinstance(plan, Plan) else None,
            branch=THINKING if branch == THINKING else ACTION if branch == ACTION else None,
            think_probability=response.think_probability,
            thinking=thinking if isinstance(thinking, str) else None,
            revised_plan=revised if isinstance(revised, Plan) else None,
            trajectory=trajectory,
            codes=codes,
            tokens=counts,
            passes=passes,
            chosen=response.chosen,
            cut=response.cut,
        )
        for index in draws
    ]
