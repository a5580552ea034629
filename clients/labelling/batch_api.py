"""Labelling through OpenAI's Batch API: questions go out in a file, answers come back in another.

A question whose answer failed the checks is in the next file that goes out, with what was wrong.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from typing import Any, Final

from pydantic import BaseModel, ConfigDict, ValidationError

from looktwice.clients.labelling.label import LabelTask, record, refused
from looktwice.clients.labelling.ledger import Ledger, StageRun
from looktwice.clients.labelling.pipeline import Job, Tally
from looktwice.clients.labelling.teachers.openai import OpenAiSettings, completion_answer, completion_request
from looktwice.clients.labelling.teachers.teacher import Answer, CheckedReflection, ReflectionRefused, judge

_URL: Final = "/v1/chat/completions"


class BatchError(ValueError):
    """A line of results that is none."""


class _Response(BaseModel):
    model_config = ConfigDict(extra="ignore")
    status_code: int
    body: dict[str, Any] = {}


class _Result(BaseModel):
    model_config = ConfigDict(extra="ignore")
    custom_id: str
    response: _Response | None = None
    error: dict[str, Any] | None = None


def batch_requests(
    ledger: Ledger, jobs: Iterable[Job[LabelTask]], settings: OpenAiSettings
) -> Iterator[dict[str, Any]]:
    """The lines of a batch: every question that the ledger has no outcome for."""
    for job in jobs:
        if ledger.has(job.key):
            continue
        answers = ledger.answers(job.key)
        verdict = judge(job.subject.question, answers)
        if isinstance(verdict, CheckedReflection):
            continue  # answered, and only not entered yet: `take_results` does that
        yield {
            "custom_id": f"{job.key}-{len(answers) + 1}",
            "method": "POST",
            "url": _URL,
            "body": completion_request(settings, job.subject.question, verdict),
        }


def read_results(lines: Iterable[str], settings: OpenAiSettings) -> dict[str, Answer]:
    """Answers by ``custom_id``; requests that ended in an error are left out, to be asked again.

    Raises:
        BatchError: a line that is no result.
    """
    answers = {}
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            result = _Result.model_validate_json(line)
        except ValidationError as error:
            raise BatchError(f"line {number} is no result of a batch: {error}") from error
        if result.error is None and result.response is not None and result.response.status_code == 200:
            answers[result.custom_id] = completion_answer(settings, json.dumps(result.response.body))
    return answers


def take_results(
    ledger: Ledger, run: StageRun, jobs: Iterable[Job[LabelTask]], results: dict[str, Answer]
) -> Tally:
    """Enter answers, each once; what fails its checks for the last time is a dead letter."""
    tally = Tally()
    for job in jobs:
        if ledger.has(job.key):
            tally.earlier += 1
            continue
        answers = ledger.answers(job.key)
        answer = results.get(f"{job.key}-{len(answers) + 1}")
        if answer is not None:
            answers.append(answer)
            ledger.answered(run, job.key, len(answers), answer)
        try:
            verdict = judge(job.subject.question, answers)
        except ReflectionRefused as error:
            letter = refused(error)
            ledger.dead_letter(run, job.key, job.scene_id, str(letter), **letter.more)
            tally.dead += 1
            continue
        if isinstance(verdict, CheckedReflection):
            ledger.finish(run, job.key, job.scene_id, record(job.subject, verdict))
            tally.done += 1
    return tally
