"""What an answer says, as far as a load test asks."""

from __future__ import annotations

from typing import Final

from pydantic import BaseModel, ValidationError

from clients.wire import Deadline
from loadtests.exchange import Branch, Verdict
from loadtests.mix import Kind

TOO_MANY_REQUESTS: Final = 429
BAD_ANSWER: Final = Verdict("failed", "bad-answer")


class _Draw(BaseModel):
    thinking: str | None = None


class _Planned(BaseModel):
    draws: list[_Draw]
    deadline: Deadline | None = None


class _Labelled(BaseModel):
    reflection: str


class _Picture(BaseModel):
    image: str
    codes: list[int]


class _Imagined(BaseModel):
    pictures: list[_Picture]


class _Result(BaseModel):
    status: int


class _Batch(BaseModel):
    results: list[_Result]


class _Problem(BaseModel):
    type: str


def read_answer(kind: Kind, status: int, content: bytes) -> Verdict:
    """The verdict on a whole answer: its status and body, or those a stream ended with."""
    if status != 200:
        return refusal(status, content)
    try:
        if kind.work == "label":
            _Labelled.model_validate_json(content)
            return Verdict("answered", branch="label")
        if kind.work == "batch":
            return _batch([result.status for result in _Batch.model_validate_json(content).results])
        if kind.work == "imagine":
            pictures = _Imagined.model_validate_json(content).pictures
            return Verdict("answered", branch="imagine") if len(pictures) == kind.n else BAD_ANSWER
        return _planned(kind, _Planned.model_validate_json(content))
    except ValidationError:
        return BAD_ANSWER


def refusal(status: int, content: bytes) -> Verdict:
    """The verdict on an answer that is none; the problem's name, or its status where it has none."""
    try:
        name = _Problem.model_validate_json(content).type.rsplit("/", 1)[-1]
    except ValidationError:
        name = f"http-{status}"
    return Verdict("rejected" if status == TOO_MANY_REQUESTS else "failed", name)


def _planned(kind: Kind, answer: _Planned) -> Verdict:
    if len(answer.draws) != kind.n:
        return BAD_ANSWER
    branch: Branch = "think" if any(draw.thinking is not None for draw in answer.draws) else "direct"
    met, cut = (answer.deadline.met, len(answer.deadline.cut)) if answer.deadline else (None, None)
    return Verdict(
        "answered", branch="reflect" if kind.work == "reflect" else branch, deadline_met=met, cut=cut
    )


def _batch(statuses: list[int]) -> Verdict:
    """A batch is as good as its worst part."""
    worst = max(statuses, default=0)
    if worst == 200:
        return Verdict("answered", branch="batch")
    rejected = TOO_MANY_REQUESTS in statuses
    return Verdict("rejected" if rejected else "failed", f"http-{TOO_MANY_REQUESTS if rejected else worst}")
