"""What comes back from the planning service: typed results, and typed errors made from problem documents."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Final, Protocol, TypeVar

import httpx
from pydantic import BaseModel, JsonValue, ValidationError

from looktwice.clients import wire, wire_scores
from looktwice.clients.wire_values import plan_of_tracks
from looktwice.model.driving.plan import Plan
from looktwice.model.driving.trajectory import (
    TEN_HZ_S,
    FloatArray,
    at_10_hz,
    check_times,
    check_trajectory,
)

BUSY_STATUSES: Final = (429, 503)
_Answer = TypeVar("_Answer", bound=BaseModel)
_Told = TypeVar("_Told", covariant=True)


class PlannerError(Exception):
    """Anything that kept a planner from getting its plan."""


class PlannerUnreachable(PlannerError):
    """No answer: the service is not there, or it broke the connection."""


class PlannerTimeout(PlannerUnreachable):
    """No answer in time."""


class BadAnswer(PlannerError):
    """An answer that is not of the contract: another service, or another version."""


class PlannerProblem(PlannerError):
    """The service answered with a problem document.

    Attributes:
        type: stable URI of the kind of problem.
        title: for people.
        detail: for people, of this request.
        status: of the HTTP answer.
        request_id: to find it in the service's log.
        errors: the places in the request that are wrong.
        retry_after_s: what the service asked to wait; None where it did not ask.
    """

    def __init__(self, problem: wire.Problem, retry_after_s: float | None = None) -> None:
        super().__init__(f"{problem.title}: {problem.detail} (request {problem.request_id})")
        self.type, self.title, self.detail = problem.type, problem.title, problem.detail
        self.status, self.request_id = problem.status, problem.request_id
        self.errors = tuple(problem.errors)
        self.retry_after_s = retry_after_s


class RequestRefused(PlannerProblem):
    """A 4xx: the same request would be refused again."""


class ServiceBusy(PlannerProblem):
    """A 429 or 503: the same request may succeed later."""


class ServiceFailed(PlannerProblem):
    """A 5xx: the service is at fault."""


@dataclass(frozen=True, eq=False)
class PlannedDraw:
    """One of the n responses.

    Attributes:
        index: 0..n-1.
        plan: the first plan.
        branch: ``Action:`` or ``Thinking:``.
        think_probability: of a second look, 0..1.
        thinking: the second look in words; None where none was taken.
        revised_plan: that it led to; likewise.
        trajectory: float32 [t, 4]: x, y, z in m and heading in rad, ego frame, at ``times_s``.
        draft_trajectory: where the first plan would have led; None without a second look or a deadline.
        times_s: of the poses, in s from now; 64 at 10 Hz, the first at 0.1 s, unless the format has its own.
        tokens: tokens per section.
        cut: what the deadline did to the second look: skipped (or a picture was), shortened, replaced;
            else None.
        consistent: whether the parts of the draw agree; None where nothing can be said.
        disagreements: which do not: ``plan_trajectory``, ``reason_change``.
        reasons: the statements that the reflection could make; None without one, and where it could make any.
        logprobs: its tokens and how likely each decision was; None unless asked for.
        sections: values of the sections that only its format has, by name.
    """

    index: int
    plan: Plan | None
    branch: wire.Branch | None
    think_probability: float | None
    thinking: str | None
    revised_plan: Plan | None
    trajectory: FloatArray
    draft_trajectory: FloatArray | None
    tokens: dict[str, int]
    cut: wire.Cut | None = None
    consistent: bool | None = None
    disagreements: tuple[str, ...] = ()
    reasons: tuple[str, ...] | None = None
    logprobs: wire.Logprobs | None = None
    times_s: tuple[float, ...] = TEN_HZ_S
    sections: Mapping[str, list[JsonValue]] = field(default_factory=dict)

    @property
    def at_10_hz(self) -> FloatArray:
        """The trajectory at 10 Hz, up to its last pose or to 6.4 s: float32 [k, 4]."""
        return at_10_hz(self.trajectory, self.times_s)


@dataclass(frozen=True, eq=False)
class PlanResult:
    """What came back for one scene.

    Attributes:
        agreed: the place of the draw whose trajectory is nearest to all others': the one to drive by.
    """

    request_id: str
    model: wire.ModelName
    draws: tuple[PlannedDraw, ...]
    agreed: int
    timing: wire.Timing
    deadline: wire.Deadline | None = None


@dataclass(frozen=True, eq=False)
class LookedAt:
    """One of the n looks at a given plan.

    Attributes:
        index: 0..n-1.
        decision: ``keep`` or ``revise``.
        thinking: the second look in words; None where none was taken.
        revised_plan: that it led to; likewise.
        plan_iou: of the given and the revised plan; 1 where it is kept.
        changes: the stretches in which they differ.
        trajectory: as of a `PlannedDraw`.
        times_s: as of a `PlannedDraw`.
        tokens: tokens per section.
        cut: as of a `PlannedDraw`.
        consistent: as of a `PlannedDraw`.
        disagreements: as of a `PlannedDraw`.
        reasons: as of a `PlannedDraw`.
        logprobs: as of a `PlannedDraw`.
    """

    index: int
    decision: str
    thinking: str | None
    revised_plan: Plan | None
    plan_iou: float
    changes: tuple[wire.PlanChange, ...]
    trajectory: FloatArray
    tokens: dict[str, int]
    cut: wire.Cut | None = None
    consistent: bool | None = None
    disagreements: tuple[str, ...] = ()
    reasons: tuple[str, ...] | None = None
    logprobs: wire.Logprobs | None = None
    times_s: tuple[float, ...] = TEN_HZ_S


@dataclass(frozen=True, eq=False)
class ReflectResult:
    """What came back for a given plan; ``think_probability`` is that of a second look at it."""

    request_id: str
    model: wire.ModelName
    plan: Plan
    think_probability: float
    draws: tuple[LookedAt, ...]
    timing: wire.Timing
    deadline: wire.Deadline | None = None


def unreachable(error: httpx.HTTPError) -> PlannerUnreachable:
    """The typed error for a request that got no answer."""
    kind = PlannerTimeout if isinstance(error, httpx.TimeoutException) else PlannerUnreachable
    return kind(f"{type(error).__name__}: {error}")


def retry_after_s(response: httpx.Response) -> float | None:
    """Seconds that ``Retry-After`` (RFC 9110, section 10.2.3) asks to wait; None where nobody asks."""
    given = response.headers.get("Retry-After", "").strip()
    try:
        seconds = float(given)
    except ValueError:
        try:
            then = parsedate_to_datetime(given)
        except ValueError:
            return None
        # HTTP's dates are in UTC, whether they say so or not.
        seconds = (then.replace(tzinfo=then.tzinfo or UTC) - datetime.now(UTC)).total_seconds()
    return max(0.0, seconds) if math.isfinite(seconds) else None


def read(response: httpx.Response, answer: type[_Answer]) -> _Answer:
    """The body of ``response`` as ``answer``; raises `PlannerError`."""
    if response.status_code != 200:
        raise problem_of(response)
    try:
        return answer.model_validate_json(response.content)
    except ValidationError as error:
        raise BadAnswer(f"{response.url} did not answer as the contract says: {error}") from error


def problem_of(response: httpx.Response) -> PlannerError:
    """The typed error of a response that is not 200."""
    try:
        problem = wire.Problem.model_validate_json(response.content)
    except ValidationError:
        return BadAnswer(f"{response.url} answered {response.status_code} without a problem document")
    return typed(problem, retry_after_s(response))


def typed(problem: wire.Problem, wait_s: float | None = None) -> PlannerProblem:
    """The typed error for a problem document."""
    kind: type[PlannerProblem] = ServiceFailed
    if problem.status in BUSY_STATUSES:
        kind = ServiceBusy
    elif problem.status < 500:
        kind = RequestRefused
    return kind(problem, wait_s)


def plan_result(response: httpx.Response) -> PlanResult:
    """The typed result of POST /v1/plan; raises `PlannerError`."""
    return planned(read(response, wire.PlanResponse), response)


def batch_results(response: httpx.Response) -> list[PlanResult | PlannerProblem]:
    """The typed results of POST /v1/plan/batch; raises `PlannerError`."""
    results = (_answered(each, response) for each in read(response, wire.BatchResponse).results)
    return [each if isinstance(each, PlannerProblem) else planned(each, response) for each in results]


def score_results(response: httpx.Response) -> list[wire_scores.ScoreResponse | PlannerProblem]:
    """The typed results of POST /v1/score/batch; raises `PlannerError`."""
    return [_answered(each, response) for each in read(response, wire_scores.ScoreBatchResponse).results]


class _OfBatch(Protocol[_Told]):
    """One scene of a batch: its answer, or its problem."""

    @property
    def response(self) -> _Told | None: ...

    @property
    def problem(self) -> wire.Problem | None: ...


def _answered(result: _OfBatch[_Told], response: httpx.Response) -> _Told | PlannerProblem:
    if result.response is not None:
        return result.response
    if result.problem is not None:
        return typed(result.problem)
    raise BadAnswer(f"{response.url} gave a result without an answer and without a problem")


def planned(answered: wire.PlanResponse, response: httpx.Response) -> PlanResult:
    """The typed result of what was ``answered`` in ``response``; raises `BadAnswer`."""
    with _contract(response):
        draws = tuple(_draw(draw) for draw in answered.draws)
        if answered.agreed >= len(draws):
            raise ValueError(f"draw {answered.agreed} is agreed on, and there are {len(draws)}")
    return PlanResult(
        request_id=answered.request_id,
        model=answered.model,
        draws=draws,
        agreed=answered.agreed,
        timing=answered.timing,
        deadline=answered.deadline,
    )


def reflect_result(response: httpx.Response) -> ReflectResult:
    """The typed result of POST /v1/reflect; raises `PlannerError`."""
    return reflected(read(response, wire.ReflectResponse), response)


def reflected(answered: wire.ReflectResponse, response: httpx.Response) -> ReflectResult:
    """The typed result of what was ``answered`` in ``response``; raises `BadAnswer`."""
    with _contract(response):
        plan = plan_of_tracks(answered.plan.tracks)
        draws = tuple(_looked_at(draw) for draw in answered.draws)
    probability, deadline = answered.think_probability, answered.deadline
    return ReflectResult(
        answered.request_id, answered.model, plan, probability, draws, answered.timing, deadline
    )


@contextmanager
def _contract(response: httpx.Response) -> Iterator[None]:
    try:
        yield
    except ValueError as error:  # `PlanError` and `GeometryError` among them
        raise BadAnswer(f"{response.url} answered with something else than a plan: {error}") from error


def _times_s(draw: wire.Draw | wire.Reflection) -> tuple[float, ...]:
    """Raises `GeometryError` where they do not ascend."""
    if draw.times_s is None:
        return TEN_HZ_S
    check_times(draw.times_s)
    return tuple(draw.times_s)


def _plan(told: wire.Plan | None) -> Plan | None:
    return None if told is None else plan_of_tracks(told.tracks)


def _looked_at(draw: wire.Reflection) -> LookedAt:
    times_s = _times_s(draw)
    return LookedAt(
        index=draw.index,
        decision=draw.decision,
        thinking=draw.thinking,
        revised_plan=_plan(draw.revised_plan),
        plan_iou=draw.plan_iou,
        changes=tuple(draw.changes),
        trajectory=check_trajectory(draw.trajectory, times_s),
        times_s=times_s,
        tokens=draw.tokens,
        cut=draw.cut,
        consistent=draw.consistent,
        disagreements=tuple(draw.disagreements),
        reasons=None if draw.reasons is None else tuple(draw.reasons),
        logprobs=draw.logprobs,
    )


def _draw(draw: wire.Draw) -> PlannedDraw:
    times_s = _times_s(draw)
    return PlannedDraw(
        index=draw.index,
        plan=_plan(draw.plan),
        branch=draw.branch,
        think_probability=draw.think_probability,
        thinking=draw.thinking,
        revised_plan=_plan(draw.revised_plan),
        trajectory=check_trajectory(draw.trajectory, times_s),
        times_s=times_s,
        draft_trajectory=None
        if draw.draft_trajectory is None
        else check_trajectory(draw.draft_trajectory, times_s),
        tokens=draw.tokens,
        cut=draw.cut,
        consistent=draw.consistent,
        disagreements=tuple(draw.disagreements),
        reasons=None if draw.reasons is None else tuple(draw.reasons),
        logprobs=draw.logprobs,
        sections={section.name: section.values for section in draw.sections},
    )
