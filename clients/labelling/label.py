"""Label: a teacher's reflection on the model's own plan, for every scene that the filter kept."""

from __future__ import annotations

import random
from collections.abc import Awaitable, Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from looktwice.clients.labelling.build_outcomes import FailingPlan, Followed, failure_of, followed_entries
from looktwice.clients.labelling.checks import FailedCheck
from looktwice.clients.labelling.ledger import Entry, Ledger, Record, StageRun
from looktwice.clients.labelling.pipeline import CannotBeDone, Job, StageStopped
from looktwice.clients.labelling.rollout import key_of
from looktwice.clients.labelling.teachers.teacher import (
    ATTEMPTS,
    CheckedReflection,
    NothingInView,
    Question,
    ReflectionRefused,
    Teacher,
    TeacherBusy,
    TeacherClosed,
    TeacherError,
    ask,
)
from looktwice.model.driving.hashing import annotations_hash, hash_of
from looktwice.model.driving.mends import Mend
from looktwice.model.driving.outcome import in_words
from looktwice.model.driving.plan import parse_plan
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.view import Surroundings

CHECKS_VERSION: Final = 5
"""Of `looktwice.clients.labelling.checks` and what they are made of; raised when they ask for something
else."""


class LabelTask(NamedTuple):
    """A question, and where it comes from.

    Attributes:
        entry: the rollout.
        question: what a teacher is asked.
        annotations: what stands for those that it was made of.
        mend: that leads to the better plan; None where it is the expert's, and nobody followed it.
    """

    entry: Entry
    question: Question
    annotations: str
    mend: Mend | None


def config_of(rollout: StageRun, teacher: Teacher, seed: int) -> Record:
    """What decides a label besides the scene and the predicted plan."""
    return {
        "rollout": rollout.id,
        "teacher": teacher.name,
        "revision": teacher.revision,
        "checks": CHECKS_VERSION,
        "attempts": ATTEMPTS,
        "seed": seed,
    }


def questions(
    ledger: Ledger,
    rollout: StageRun,
    scenes: Path,
    *,
    plans_per_scene: int = 1,
    seed: int = 0,
    group: int | None = None,
) -> Iterator[LabelTask]:
    """What a teacher is to be asked: each kept scene with some of the plans that were kept of it.

    Which plans is left to chance, once and for all for a scene and a seed. Where plans were followed, a
    question says what its plan failed at, and the better plan is the mended one.
    """
    followed = followed_entries(ledger, rollout)
    for labelled in read_scenes(scenes, dense=False, unlabelled=lambda _: None, group=group):
        kept = ledger.selected(key_of(rollout, labelled))
        if kept is None:
            continue
        entry, draws = kept
        annotations = annotations_hash(labelled)
        for text in predicted_plans(entry, draws, plans_per_scene, seed):
            fate = followed.get(entry.key)
            failing = None if fate is None else failure_of(text, entry, Followed.of(fate.record))
            mend = None if failing is None else failing.better.mend
            yield LabelTask(entry, _question(labelled, entry, text, seed, failing), annotations, mend)


def predicted_plans(entry: Entry, draws: Sequence[int], count: int, seed: int) -> list[str]:
    """Different ones among the plans of some draws, at random."""
    free = entry.record["free"]
    texts = list(dict.fromkeys(free[draw]["plan"] for draw in draws))
    random.Random(f"{entry.key}/{seed}").shuffle(texts)
    return texts[:count]


def jobs(run: StageRun, asked: Iterator[LabelTask]) -> Iterator[Job[LabelTask]]:
    """Questions as pieces of work."""
    for each in asked:
        question = each.question
        parts: list[str] = [run.id, each.entry.key, str(question.predicted), each.annotations]
        # Another hint or another better plan, another question; without them it is as it always was.
        if question.outcome is not None:
            parts += [in_words(question.outcome), str(question.expert)]
        key = hash_of(*parts)
        yield Job(key, each.entry.scene_id, each)


def labeller(
    ledger: Ledger, run: StageRun, teacher: Teacher
) -> Callable[[Job[LabelTask]], Awaitable[Record]]:
    """Asks ``teacher`` and makes records of its answers, each of which is in the ledger before it is read."""

    async def label(job: Job[LabelTask]) -> Record:
        try:
            reflection = await ask(
                teacher,
                job.subject.question,
                ledger.answers(job.key),
                lambda attempt, answer: ledger.answered(run, job.key, attempt, answer),
            )
        except TeacherBusy:
            raise
        except TeacherClosed as error:
            raise StageStopped(f"{teacher.name}: {error}") from error
        except NothingInView as error:
            raise CannotBeDone(str(error), fault=False) from error
        except TeacherError as error:
            raise CannotBeDone(str(error)) from error
        except ReflectionRefused as error:
            raise refused(error) from error
        return record(job.subject, reflection)

    return label


def record(asked: LabelTask, reflection: CheckedReflection) -> Record:
    """What the ledger keeps of a label."""
    return {
        "rollout": asked.entry.key,
        "predicted_plan": str(asked.question.predicted),
        "failure": None if asked.question.outcome is None else in_words(asked.question.outcome),
        "mend": asked.mend,
        "expert_plan": str(asked.question.expert),
        "reflection": reflection.text,
        "attempts": reflection.attempts,
        "failed_checks": _told(reflection.failed),
    }


def refused(error: ReflectionRefused) -> CannotBeDone:
    """The dead letter of a question whose answers all failed."""
    return CannotBeDone(str(error), text=error.text, failed_checks=_told(error.failed))


def _told(failed: Sequence[FailedCheck]) -> list[str]:
    return [f"{each.check}: {each.detail}" for each in failed]


def _question(
    labelled: LabelledScene, entry: Entry, predicted: str, seed: int, failing: FailingPlan | None
) -> Question:
    better, outcome = entry.record["expert_plan"], None
    if failing is not None:
        better, outcome = failing.better.plan, failing.outcome
    told = parse_plan(predicted), parse_plan(better)
    return Question(labelled.scene, *told, Surroundings.of(labelled), seed, outcome)
