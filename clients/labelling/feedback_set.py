"""The feedback set of ELF-VLA section 7.2: a served model's own responses, judged, with feedback on each.

Two stages of a ledger: in ``inference`` the model responds in each scene and its trajectories are scored, in
``feedback`` a teacher writes on a sample of correct and of wrong ones. Sampling is a pure function of what
was inferred and of a seed, so that a run that was killed goes on with the same responses.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from looktwice.clients import wire
from looktwice.clients.answers import PlannedDraw
from looktwice.clients.labelling.ledger import Entry, Ledger, Record, StageRun
from looktwice.clients.labelling.pipeline import CannotBeDone, Job, StageStopped
from looktwice.clients.labelling.rollout import key_of, of_the_service
from looktwice.clients.labelling.teachers.feedback_teacher import FeedbackTeacher, ask_feedback, question_of
from looktwice.clients.labelling.teachers.teacher import (
    ATTEMPTS,
    ReflectionRefused,
    TeacherBusy,
    TeacherClosed,
    TeacherError,
)
from looktwice.clients.planner import AsyncPlannerClient
from looktwice.model.driving.feedback_store import FeedbackRow
from looktwice.model.driving.hashing import hash_of, judged_hash
from looktwice.model.driving.pdm.comfort import Version
from looktwice.model.driving.pdm.judged import THRESHOLD, JudgedPlan
from looktwice.model.driving.pdm.judging import PlanExplanation, judged_in_scene
from looktwice.model.driving.pdm.labelled import plans_of
from looktwice.model.driving.pdm.profiles import SolveError
from looktwice.model.driving.pdm.rule_teacher import NAME, REVISION, feedback_on
from looktwice.model.driving.pdm.world import Array, ScoreError
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.trajectory import HALF_SECONDS_S, TEN_HZ_S

FACTS_VERSION: Final = 1
"""Of scores and facts; raised when the same trajectory comes to be judged otherwise."""
_DECIMALS: Final = 4


@dataclass(frozen=True)
class Inference:
    """How the model responds; a part of every key.

    Attributes:
        n: draws of a scene.
        temperature, top_p, seed, thinking: as in `wire.Controls`.
        route, tracks: whether the model is told them.
        version: whose rules trajectories are scored by.
        format: that it responds in; the model's first one where none is named.
    """

    n: int = 2
    temperature: float = 1.0
    top_p: float = 1.0
    seed: int = 0
    thinking: wire.Thinking = "adaptive"
    route: bool = True
    tracks: bool = False
    version: Version = "v1.1"
    format: str | None = None

    @property
    def controls(self) -> wire.Controls:
        """As the service takes them."""
        return wire.Controls(
            n=self.n, thinking=self.thinking, temperature=self.temperature, top_p=self.top_p, seed=self.seed
        )


@dataclass(frozen=True)
class FeedbackSample:
    """Which of the responses get feedback.

    Attributes:
        threshold: from which score on a response is correct.
        correct, wrong: most responses of each kind.
        seed: of the choice.
    """

    threshold: float = THRESHOLD
    correct: int = 4000
    wrong: int = 4000
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.threshold <= 1:
            raise ValueError(f"a threshold lies between 0 and 1, not at {self.threshold:g}")


class Chosen(NamedTuple):
    """A response that gets feedback: one draw of what was inferred in a scene."""

    labelled: LabelledScene
    entry: Entry
    draw: int


def inference_config(model: wire.ModelName, inference: Inference) -> Record:
    """What decides an inference besides the scene."""
    # No format, no entry: what was inferred before one could be named is found again.
    given = {name: value for name, value in asdict(inference).items() if value is not None}
    return {"model": model.name, "revision": model.revision, "facts": FACTS_VERSION, **given}


def feedback_config(inference: StageRun, teacher: FeedbackTeacher | None, threshold: float) -> Record:
    """What decides feedback besides the response; None is the built-in teacher."""
    return {
        "inference": inference.id,
        "teacher": NAME if teacher is None else teacher.name,
        "revision": REVISION if teacher is None else teacher.feedback_revision,
        "attempts": ATTEMPTS,
        "threshold": threshold,
    }


async def infer(
    planner: AsyncPlannerClient, labelled: LabelledScene, model: wire.ModelName, inference: Inference
) -> Record:
    """The record of one scene: what the model responds, and what that is worth.

    Raises:
        TryLater: the service is busy or away.
        CannotBeDone: it refuses the scene, or its trajectories cannot be scored.
        StageStopped: another model answers than before.
    """
    scene = labelled.given(route=inference.route, tracks=inference.tracks)
    with of_the_service():
        answer = await planner.plan(scene, inference.controls, format=inference.format)
    if answer.model != model:
        raise StageStopped(
            f"the service now runs {answer.model.name} {answer.model.revision} instead of {model.revision}"
        )
    draws = [_response(draw) for draw in answer.draws]
    judged = await asyncio.to_thread(judge, labelled, draws, inference.version, THRESHOLD)
    return {
        "draws": [
            draw | {"score": plan.score, "is_partial": plan.is_partial}
            for draw, plan in zip(draws, judged, strict=True)
        ]
    }


def judge(
    labelled: LabelledScene, draws: Sequence[Mapping[str, Any]], version: Version, threshold: float
) -> list[JudgedPlan]:
    """Responses of a scene with facts, measured against the expert; raises `CannotBeDone`."""
    plans = np.array([draw["trajectory"] for draw in draws], np.float64)
    said = [PlanExplanation(draw["plan"], draw["think"]) for draw in draws]
    try:
        return judged_in_scene(labelled, plans, version, threshold, said)
    except (ScoreError, SolveError) as error:
        raise CannotBeDone(f"the scene cannot be scored: {error}") from error


def sampled(ledger: Ledger, inference: StageRun, sample: FeedbackSample) -> dict[str, list[int]]:
    """The draws that get feedback, by the keys of what was inferred.

    Draws are taken in an order by lot that each has for itself: more scenes add to it and do not shuffle it.
    """
    lots: dict[bool, list[tuple[str, str, int]]] = {True: [], False: []}
    for entry in ledger.entries(inference):
        for number, draw in enumerate(entry.record["draws"]):
            lot = hash_of(sample.seed, entry.key, number)
            lots[draw["score"] >= sample.threshold].append((lot, entry.key, number))
    taken = sorted(lots[True])[: sample.correct] + sorted(lots[False])[: sample.wrong]
    chosen: dict[str, list[int]] = {}
    for _, key, number in taken:
        chosen.setdefault(key, []).append(number)
    return chosen


def feedback_jobs(
    ledger: Ledger, inference: StageRun, run: StageRun, chosen: Mapping[str, Sequence[int]], scenes: Path
) -> Iterator[Job[Chosen]]:
    """Chosen responses as pieces of work, scene by scene."""
    for labelled in read_scenes(scenes, dense=False, unlabelled=lambda _: None):
        entry = ledger.find(key_of(inference, labelled))
        for draw in sorted(chosen.get(entry.key, ())) if entry is not None else ():
            assert entry is not None
            key = feedback_key(run, entry.key, draw, judged_hash(labelled))
            yield Job(key, entry.scene_id, Chosen(labelled, entry, draw))


def feedback_key(run: StageRun, inferred: str, draw: int, judged_by: str) -> str:
    """What the feedback on one response is found by."""
    return hash_of(run.id, inferred, draw, judged_by)


def writer(
    ledger: Ledger, run: StageRun, teacher: FeedbackTeacher | None, version: Version, threshold: float
) -> Callable[[Job[Chosen]], Awaitable[Record]]:
    """Makes records of feedback: the verdict on what is correct, sections on what is wrong (section 7.2)."""

    async def write(job: Job[Chosen]) -> Record:
        chosen = job.subject
        draw = chosen.entry.record["draws"][chosen.draw]
        (judged,) = await asyncio.to_thread(judge, chosen.labelled, [draw], version, threshold)
        attempts = 0
        if teacher is None or judged.correct:
            text = str(feedback_on(judged))
        else:
            text, attempts = await _asked(ledger, run, job.key, teacher, judged)
        return {
            "inference": chosen.entry.key,
            "draw": chosen.draw,
            "correct": judged.correct,
            "feedback": text,
            "facts": [asdict(fact) for fact in judged.facts],
            "by_rule": teacher is None or judged.correct,
            "attempts": attempts,
        }

    return write


async def _asked(
    ledger: Ledger, run: StageRun, key: str, teacher: FeedbackTeacher, judged: JudgedPlan
) -> tuple[str, int]:
    """An outside teacher's text and how often it was asked; each answer is kept before it is read."""
    try:
        written = await ask_feedback(
            teacher,
            question_of(judged),
            ledger.answers(key),
            lambda attempt, answer: ledger.answered(run, key, attempt, answer),
        )
    except TeacherBusy:
        raise
    except TeacherClosed as error:
        raise StageStopped(f"{teacher.name}: {error}") from error
    except TeacherError as error:
        raise CannotBeDone(str(error)) from error
    except ReflectionRefused as error:
        failed = [f"{each.check}: {each.detail}" for each in error.failed]
        raise CannotBeDone(str(error), text=error.text, failed_checks=failed) from error
    return str(written.feedback), written.attempts


def rows(
    ledger: Ledger, inference: StageRun, run: StageRun, chosen: Mapping[str, Sequence[int]]
) -> Iterator[FeedbackRow]:
    """Feedback on the chosen responses, as the file holds it."""
    for entry in ledger.entries(run):
        record = entry.record
        if record["draw"] not in chosen.get(record["inference"], ()):
            continue
        inferred = ledger.find(record["inference"])
        assert inferred is not None, "feedback is entered behind what it is about"
        draw = inferred.record["draws"][record["draw"]]
        yield FeedbackRow(
            scene_id=entry.scene_id,
            draw=record["draw"],
            plan=draw["plan"],
            think=draw["think"],
            trajectory=draw["trajectory"],
            version=inference.config["version"],
            score=draw["score"],
            is_partial=draw["is_partial"],
            threshold=run.config["threshold"],
            correct=record["correct"],
            feedback=record["feedback"],
            facts=json.dumps(record["facts"]),
            model=inference.config["model"],
            model_revision=inference.config["revision"],
            teacher=NAME if record["by_rule"] else run.config["teacher"],
            teacher_revision=REVISION if record["by_rule"] else run.config["revision"],
            attempts=record["attempts"],
            key=entry.key,
            written_at=entry.ended_at,
        )


def _response(draw: PlannedDraw) -> dict[str, Any]:
    plan = draw.revised_plan or draw.plan
    return {
        "plan": None if plan is None else str(plan),
        "think": draw.thinking,
        "trajectory": np.round(_scored_poses(draw), _DECIMALS).tolist(),
    }


def _scored_poses(draw: PlannedDraw) -> Array:
    """A draw's trajectory as it is scored, [8, 3] or [64, 3]; raises `CannotBeDone`."""
    if draw.times_s == TEN_HZ_S:
        return plans_of(draw.trajectory)
    if len(draw.times_s) >= len(HALF_SECONDS_S) and np.allclose(
        draw.times_s[: len(HALF_SECONDS_S)], HALF_SECONDS_S
    ):
        return plans_of(draw.trajectory[: len(HALF_SECONDS_S)])
    raise CannotBeDone("the model's trajectory has neither 64 poses at 0.1 s nor 8 at 0.5 s")
