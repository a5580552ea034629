"""What every engine does with a request before decoding, and with a response after it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, TypeAlias

from looktwice.model.driving.images import ImageError
from looktwice.model.driving.plan import Plan
from looktwice.model.driving.scene import Scene
from looktwice.model.driving.trajectory import FloatArray, GeometryError, check_trajectory
from looktwice.model.engines.engine import (
    CodesWritten,
    Draw,
    Event,
    PlanRequest,
    RequestError,
    SectionFinished,
    TextWritten,
)
from looktwice.model.engines.reason_mask import ReasonMask
from looktwice.model.engines.response import Response, SectionText
from looktwice.model.families.family import Attempt, Branch, Family, PictureRequest
from looktwice.model.formats.cursor import CompiledFormat, Cursor, FormatVocabulary
from looktwice.model.formats.fixed import FixedValues
from looktwice.model.formats.pieces import NOTHING, FormatError
from looktwice.model.formats.text import parse
from looktwice.model.network.codec import TrajectoryCodec
from looktwice.model.network.model_card import ModelCard

if TYPE_CHECKING:
    # Scheduling imports this module, and needs no torch.
    from looktwice.model.network.inputs import InputBuilder, ModelInputs
    from looktwice.model.network.visual_codes import Frame, VisualCodes


PictureCodes: TypeAlias = tuple[int, ...] | None
"""Those of a picture that is expected, or None."""


def start_cursor(
    request: PlanRequest,
    card: ModelCard,
    families: Mapping[str, Family],
    formats: Mapping[str, CompiledFormat],
    expected: PictureCodes = None,
) -> Cursor:
    """The cursor at which the response to a request begins.

    Args:
        families, formats: of the checkpoint, by name.
        expected: see `InputBuilder.expected`.

    Raises:
        RequestError: it can never be served: an unknown format, a missing camera, a prefill that the format
            cannot write, an attempt that its family does not refine, a picture that it does not imagine, or
            thinking that it cannot be asked for.
    """
    if request.format not in formats:
        known = ", ".join(formats)
        raise RequestError(f"unknown format {request.format!r}; this checkpoint writes {known}")
    family = families[request.format]
    if request.controls.prefill is not None and family.first_plan is None:
        raise RequestError(f"prefill: responses in format {request.format!r} have no plan to be given")
    _check_attempt(request, family)
    _check_thinking(request, family)
    picks = decided(request, family)
    try:
        start = formats[request.format].start(
            given_plans(request, family), picks, fixed_values(request, family, expected)
        )
    except FormatError as error:
        raise RequestError(f"prefill: {error}") from error
    cameras = {clip.camera for clip in request.scene.clips}
    if missing := [camera for camera in card.cameras if camera not in cameras]:
        raise RequestError(f"the scene lacks camera {', '.join(missing)}, which this checkpoint needs")
    return start


def _check_thinking(request: PlanRequest, family: Family) -> None:
    controls = request.controls
    if refused := family.thinking_refused(controls.thinking):
        raise RequestError(f"thinking: {refused}")
    if controls.think_threshold is not None and family.branch is None:
        raise RequestError(f"think_threshold: responses in format {request.format!r} have no branch")


def _check_attempt(request: PlanRequest, family: Family) -> None:
    if family.refines != (request.attempt is not None):
        wants = "refines an attempt, and the request has none" if family.refines else "refines no attempt"
        raise RequestError(f"attempt: format {request.format!r} {wants}")
    if request.attempt is not None:
        try:
            check_trajectory(request.attempt.trajectory, family.times_s)
        except GeometryError as error:
            raise RequestError(f"attempt: {error}") from error


def decided(request: PlanRequest, family: Family) -> dict[str, str]:
    """The options that the caller has decided, by the name of their choice; raises `RequestError`."""
    controls = request.controls
    if family.imagination is not None:
        return family.imagination.picks(controls.imagines, controls.camera)
    if controls.imagine != "auto" or controls.camera is not None or controls.imagine_once:
        raise RequestError(f"imagine: responses in format {request.format!r} imagine no pictures")
    return {}


def fixed_values(request: PlanRequest, family: Family, expected: PictureCodes) -> FixedValues:
    """What sections say that is decided beforehand."""
    controls = request.controls
    thoughts = family.unthought if controls.thinking == "never" else {}
    if family.imagination is None or controls.imagine == "never":
        return thoughts
    return {**family.imagination.fixed_values(expected, controls.motion, controls.picture), **thoughts}


def drawn_as(request: PlanRequest, family: Family, cursor: Cursor, draws: Sequence[int]) -> Sequence[int]:
    """Whose random numbers draws take: up to a picture that all share, those of the first draw."""
    imagination = family.imagination
    if not request.controls.imagine_once or imagination is None:
        return draws
    return [0] * len(draws) if cursor.section in imagination.sections else draws


def given_plans(request: PlanRequest, family: Family) -> dict[str, Plan]:
    """The plans that the caller gives, by section."""
    prefill = request.controls.prefill
    return {} if prefill is None or family.first_plan is None else {family.first_plan: prefill}


def leads_to_reflection(branch: Branch, cursor: Cursor, token: int) -> bool:
    """At the branch: whether ``token`` leads to a second look."""
    return branch.reflecting in cursor.option_texts(token)


def events_of(
    request: PlanRequest,
    family: Family,
    response: Response,
    finished: Sequence[SectionText],
    draws: Iterable[int],
    vocabulary: FormatVocabulary,
) -> list[Event]:
    """What draws have to tell when their response has grown: all of them have written it alike.

    Args:
        request, family: what is asked, and of whom.
        response: as it is now.
        finished: the sections that were finished since they told last.
        draws: their indices.
        vocabulary: of the checkpoint.
    """
    values, indices = NOTHING, list(draws)
    if request.live and finished:
        values = response.values(vocabulary, given_plans(request, family))
    events: list[Event] = [
        SectionFinished(index, *section, values.all(section.name))
        for section in finished
        for index in indices
    ]
    if request.live and (new := response.new_text(vocabulary)):
        events += [TextWritten(index, *new) for index in indices]
    if request.live and (codes := response.cursor.codes_written):
        events += [CodesWritten(index, response.cursor.section, codes) for index in indices]
    return events


def inputs_of(
    builder: InputBuilder, scene: Scene, format: str, attempt: Attempt | None, view: PictureRequest | None
) -> ModelInputs:
    """A scene as the network takes it.

    Raises:
        RequestError: it cannot be made into inputs (a missing camera).
        ImageError: a picture is damaged.
    """
    try:
        return builder.build(scene, format, attempt, view)
    except ImageError:
        raise
    except ValueError as error:
        raise RequestError(str(error)) from error


def prompt_tokens(builder: InputBuilder, request: PlanRequest) -> int:
    """See `Engine.prompt_tokens`."""
    view = request.controls.view
    return len(builder.prompt_for(request.scene, request.format, request.attempt, view).ids)


def read(
    request: PlanRequest,
    family: Family,
    response: Response,
    passes: int,
    draws: Iterable[int],
    vocabulary: FormatVocabulary,
    codec: TrajectoryCodec | None,
    reason_mask: ReasonMask | None = None,
) -> list[Draw]:
    """The draws that wrote ``response``: all the same, but for their index.

    ``codec`` is None where the checkpoint writes no trajectory codes.

    Raises:
        FormatError: the text is no response of the format.
        GeometryError: its family makes something else of it than a trajectory.
    """
    ids = tuple(token.id for token in response.tokens)
    text = vocabulary.decode(ids)
    values = parse(response.cursor.compiled, text, given_plans(request, family))

    def decode(codes: Sequence[int]) -> FloatArray:
        if codec is None:
            raise FormatError("the checkpoint has no codec for trajectory codes")
        trajectory: FloatArray = codec.decode(request.scene.history[None], [codes])[0]
        return trajectory

    reading = family.read(values, decode)
    thinking = family.reflected(values)
    counts = dict(Counter(token.section for token in response.tokens))
    return [
        Draw(
            index=index,
            text=text,
            plan=reading.plan,
            branch=reading.branch,
            think_probability=response.think_probability,
            thinking=thinking,
            revised_plan=reading.revised_plan,
            trajectory=check_trajectory(reading.trajectory, family.times_s),
            codes=reading.codes,
            tokens=counts,
            passes=passes,
            chosen=response.chosen,
            cut=response.cut,
            times_s=family.times_s,
            ids=ids,
            reasons=None if reason_mask is None or thinking is None else reason_mask.statements,
            logprobs=tuple(response.logprobs) if request.controls.logprobs else (),
            section_logprobs=_by_section(response) if request.controls.logprobs else {},
            foreseen=reading.foreseen,
            sections=family.own(values),
            action=reading.action,
        )
        for index in draws
    ]


def _by_section(response: Response) -> dict[str, float]:
    """How likely the text of each section was, as a logarithm."""
    sums = dict.fromkeys((token.section for token in response.tokens), 0.0)
    for token, logprob in zip(response.tokens, response.logprobs, strict=True):
        sums[token.section] += logprob or 0.0
    return sums


def painted(visual_codes: VisualCodes | None, request: PlanRequest, codes: Sequence[int]) -> Frame:
    """See `Engine.paint`; raises `RequestError` without codes of pictures."""
    if visual_codes is None:
        raise RequestError("this checkpoint has no codes of pictures to paint with")
    # Scheduling, which reads requests too, needs no torch.
    from looktwice.model.network.inputs import moved_pictures

    view = request.controls.view
    return visual_codes.decode(codes, None if view is None else moved_pictures(request.scene, view))
