"""Teachers of feedback: what one is asked about a failed plan, and what is asked of its answer.

Source: ELF-VLA, section 7.2 and figure 7 of its supplement.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol, runtime_checkable

from looktwice.clients.labelling.checks import FailedCheck
from looktwice.clients.labelling.teachers.teacher import ATTEMPTS, Answer, ReflectionRefused
from looktwice.model.driving.pdm.failures import Fact
from looktwice.model.driving.pdm.feedback import BEGIN, END, SECTIONS, Feedback, FeedbackError, parse_feedback
from looktwice.model.driving.pdm.judged import (
    JudgedPlan,
    Measurement,
    Waypoint,
    called,
    foreign_numbers,
    numbers,
)
from looktwice.model.driving.pdm.rule_teacher import SHORT
from looktwice.model.driving.pdm.scoring import FACTORS, WEIGHTS

FEEDBACK_PROMPT_VERSION: Final = 1
"""Raised with every change of wording: other words, other answers."""
_MOST_SHOWN: Final = 5
"""Numbers that a complaint names."""

FEEDBACK_SYSTEM: Final = f"""You are an expert in autonomous driving and look at a trajectory that a model \
has planned and that has failed in simulation. You say what was wrong and how to mend it, so that the model \
can plan again.

Output requirements: write your critique inside {BEGIN} and {END}, in these five sections, a paragraph each:
**1. Meta action analysis:** State whether the planned meta action matches the ground truth's, and whether \
the choice or its execution is at fault.
**2. Think process analysis:** Evaluate the model's reasoning: what it overlooks, or draws no conclusion from.
**3. Safety failure:** Based on NC and DAC, state the reason.
**4. Efficiency failure:** Based on TTC and EP, quantify the failure.
**5. Actionable correction:** Provide one consolidated plan of correction.

Rules:
- Name only numbers that you are given, in digits and with the unit that they are given in. You may round \
them. Compute no new ones.
- Coordinates are in metres in the car's frame of now: x ahead, y to the left.
- Write plain sentences, without lists. Write nothing outside of the tags."""


@dataclass(frozen=True)
class FeedbackQuestion:
    """What a teacher is asked about one plan.

    Attributes:
        prompt: all that it is told.
        numbers: those that its answer may name.
        names: of others, in which digits are no numbers.
    """

    prompt: str
    numbers: tuple[Measurement, ...]
    names: tuple[str, ...]


def question_of(judged: JudgedPlan) -> FeedbackQuestion:
    """The question about a plan (figure 7: inputs of the teacher model)."""
    return FeedbackQuestion("\n".join(_prompt(judged)), numbers(judged), judged.names)


@runtime_checkable
class FeedbackTeacher(Protocol):
    """Writes feedback; ``name`` and ``feedback_revision`` are the provenance of what it writes."""

    @property
    def name(self) -> str:
        """Who it is."""
        ...

    @property
    def feedback_revision(self) -> str:
        """Changes when it would write something else: model, prompt, sampling."""
        ...

    async def write_feedback(
        self, question: FeedbackQuestion, complaints: Sequence[FailedCheck] = ()
    ) -> Answer:
        """Five sections; ``complaints`` say what was wrong with earlier ones.

        Raises:
            TeacherError: it cannot answer; see
                `looktwice.clients.labelling.teachers.teacher.Teacher.reflect`.
        """
        ...


class Written(NamedTuple):
    """Feedback that passed all checks; ``failed`` are those that earlier answers did not pass."""

    feedback: Feedback
    attempts: int
    failed: tuple[FailedCheck, ...]


def check_feedback(text: str, question: FeedbackQuestion) -> Feedback | FailedCheck:
    """The sections of a teacher's text, or what is wrong with it."""
    try:
        found = parse_feedback(text)
    except FeedbackError as error:
        return FailedCheck("form", str(error))
    if not isinstance(found, Feedback):
        return FailedCheck("form", "write the five sections, not a verdict")
    if foreign := foreign_numbers(found, question.numbers, question.names):
        shown = ", ".join(foreign[:_MOST_SHOWN])
        return FailedCheck("number", f"name no numbers but those that are given: {shown} is none of them")
    return found


async def ask_feedback(
    teacher: FeedbackTeacher,
    question: FeedbackQuestion,
    answers: list[Answer],
    keep: Callable[[int, Answer], None] = lambda attempt, answer: None,
) -> Written:
    """A teacher's checked feedback; it is asked again with what was wrong, `ATTEMPTS` times in all.

    Args:
        teacher: who is asked.
        question: what.
        answers: that it gave before to this question, in order; new ones are added.
        keep: told of each new answer, with its number from 1 on, before anything is made of it.

    Raises:
        TeacherError: it cannot answer.
        ReflectionRefused: none of its answers passed the checks.
    """
    failed: list[FailedCheck] = []
    for attempt in range(1, ATTEMPTS + 1):
        if attempt > len(answers):
            answers.append(await teacher.write_feedback(question, failed))
            keep(attempt, answers[-1])
        answer = answers[attempt - 1]
        verdict = (
            FailedCheck("answer", answer.unusable)
            if answer.unusable
            else check_feedback(answer.text, question)
        )
        if isinstance(verdict, Feedback):
            return Written(verdict, attempt, tuple(failed))
        failed.append(verdict)
    raise ReflectionRefused(answers[ATTEMPTS - 1].text, failed[-1:], failed, ATTEMPTS)


def _prompt(judged: JudgedPlan) -> Iterator[str]:
    yield f"Command: {judged.command or 'not given'}"
    yield f"Velocity: {judged.course.speed_mps:.2f} m/s"
    yield f"Acceleration: {judged.acceleration_mps2:.2f} m/s2"
    yield f"Fault trajectory: {_trajectory(judged.waypoints)}"
    kind = "partial score" if judged.is_partial else "score"
    yield f"Trajectory score: {kind} {judged.score:.4f}, threshold {judged.threshold:g}; {_rule(judged)}"
    known = [f"{SHORT[name]} {value:.4f}" for name, value in judged.sub_scores.items() if value is not None]
    yield f"Sub-scores: {', '.join(known)}"
    yield f"Ground truth trajectory: {_trajectory(judged.true_waypoints) or 'not known'}"
    for whose, course in (("Planned", judged.course), ("Ground truth's", judged.true_course)):
        if course is not None:
            yield (
                f"{whose} meta action: {course.longitudinal}, {course.lateral}; mean speed "
                f"{course.mean_speed_mps:.2f} m/s, at the end {course.end_speed_mps:.2f} m/s"
            )
    yield "Facts of the failure:"
    yield from map(_fact, judged.facts)
    yield f"The model's plan in words: {judged.words or 'not given'}"
    yield f"The model's reasoning: {judged.think or 'not given'}"
    yield f"Feedback format: the sections {', '.join(f'{heading!r}' for heading in SECTIONS.values())}."


def _rule(judged: JudgedPlan) -> str:
    factors = " x ".join(SHORT[name] for name in FACTORS[judged.version])
    weights = WEIGHTS[judged.version]
    means = " + ".join(f"{weight:g} {SHORT[name]}" for name, weight in weights.items())
    return f"it is {factors} x ({means}) / {sum(weights.values()):g}"


def _trajectory(waypoints: Sequence[Waypoint]) -> str:
    return ", ".join(f"[{each.x_m:.2f}, {each.y_m:.2f}] at {each.time_s:.1f} s" for each in waypoints)


def _fact(fact: Fact) -> str:
    parts = [f"- {SHORT[fact.sub_score]} is {fact.value:.4f}"]
    if fact.time_s is not None:
        parts.append(f"from {fact.time_s:.1f} s on")
    if fact.other is not None:
        parts.append(f"with {fact.other.kind} {called(fact.other)}")
        parts += [
            f"{name} {value:.2f}" for name, value in vars(fact.other).items() if isinstance(value, float)
        ]
    if fact.side is not None:
        parts.append(f"on the {fact.side}")
    for measure in fact.measures:
        limit = "" if measure.limit is None else f" (limit {measure.limit:.2f})"
        parts.append(f"{measure.name} {measure.value:.2f}{limit}")
    return ", ".join(parts)
