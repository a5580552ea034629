"""Feedback on trajectories by the built-in teacher, where scores are worked out; also what callers bring."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Final, Literal

import looktwice.clients.wire_feedback as wire_feedback
from looktwice.clients.labelling.teachers.feedback_teacher import (
    FeedbackQuestion,
    check_feedback,
    question_of,
)
from looktwice.clients.wire import TeacherName
from looktwice.model.driving.hashing import hash_of
from looktwice.model.driving.pdm.course import Course
from looktwice.model.driving.pdm.failures import Fact
from looktwice.model.driving.pdm.feedback import Feedback, FeedbackError, RuleFeedback, parse_feedback
from looktwice.model.driving.pdm.judged import JudgedPlan, Measurement
from looktwice.model.driving.pdm.judging import PlanExplanation, judged_plans
from looktwice.model.driving.pdm.rule_teacher import NAME, REVISION, feedback_on
from looktwice.model.driving.pdm.world import ScoreError
from looktwice.service.problems import INVALID_FEEDBACK, INVALID_LABELS, OTHER_PLAN, at
from looktwice.service.scenes.bundled import BundledScenes
from looktwice.service.scoring.request_scores import rounded, scores_of, trajectory_of

GROUND_TRUTH: Final = "ground_truth"
CALLER: Final = "caller"
_ID_DIGITS: Final = 12
_DECIMALS: Final = 6


@dataclass(frozen=True)
class FeedbackAnswer:
    """Feedback by rule, and for each trajectory what another teacher would be asked; None where nothing."""

    response: wire_feedback.FeedbackResponse
    questions: tuple[FeedbackQuestion | None, ...]

    def to_json(self) -> bytes:
        """As it goes from one process to the other."""
        questions = [None if each is None else asdict(each) for each in self.questions]
        return json.dumps([self.response.model_dump(), questions]).encode()

    @classmethod
    def of_json(cls, content: bytes) -> FeedbackAnswer:
        """What `to_json` made bytes of."""
        response, questions = json.loads(content)
        return cls(
            wire_feedback.FeedbackResponse.model_validate(response),
            tuple(None if each is None else _question(**each) for each in questions),
        )


def _question(prompt: str, numbers: list[list[object]], names: list[str]) -> FeedbackQuestion:
    return FeedbackQuestion(prompt, tuple(Measurement(*each) for each in numbers), tuple(names))  # type: ignore[arg-type]


def answer_feedback(
    asked: wire_feedback.FeedbackRequest, bundled: BundledScenes, request_id: str
) -> FeedbackAnswer:
    """The answer to one request, the built-in teacher having written.

    Raises:
        ProblemError: what `looktwice.service.scoring.request_scores.scored` refuses; labels that no
            trajectory can be judged by; written feedback that is for another plan, or tells what is no fact.
    """
    truth = None if asked.ground_truth is None else trajectory_of(asked.ground_truth, "/ground_truth")
    if truth is not None and asked.reference is None:
        # What the human drove is what progress is measured against, where nothing else is given.
        asked = asked.model_copy(update={"reference": asked.ground_truth, "against": GROUND_TRUTH})
    # A teacher needs a verdict where a score may be left open.
    found = scores_of(asked, bundled, careful=True)
    truth = found.expert if truth is None else truth
    said = [each or wire_feedback.PlanSaid() for each in asked.said or [None] * len(asked.trajectories)]
    try:
        judged = judged_plans(
            found.world,
            found.plans,
            found.scores,
            found.others,
            threshold=asked.threshold,
            truth=truth,
            said=[PlanExplanation(each.plan, each.think) for each in said],
            command=asked.command,
            centre=found.centre,
        )
    except ScoreError as error:
        raise at(INVALID_LABELS, "/labels", error.detail) from None
    whole = rounded(found.scores.score, len(judged))
    partial = rounded(found.scores.partial_score, len(judged))
    told, questions = [], []
    for row, plan in enumerate(judged):
        plan_id = plan_id_of(asked.trajectories[row])
        written = said[row].written
        feedback, writer = _by_rule(plan, asked.mode), NAME
        if written is not None:
            feedback, writer = _checked(written, plan, plan_id, f"/said/{row}/written"), CALLER
        told.append(
            wire_feedback.PlanFeedback(
                plan_id=plan_id,
                score=whole[row],
                partial_score=partial[row],
                judged_by="partial_score" if plan.is_partial else "score",
                correct=plan.correct,
                sub_scores={name: _rounded(value) for name, value in plan.sub_scores.items()},
                facts=[_fact(fact) for fact in plan.facts],
                course=_course(plan.course),
                true_course=None if plan.true_course is None else _course(plan.true_course),
                sections=sections_of(feedback),
                text=str(feedback),
                written_by=writer,
                attempts=0,
            )
        )
        outside = writer == NAME and isinstance(feedback, Feedback)
        questions.append(question_of(plan) if outside else None)
    response = wire_feedback.FeedbackResponse(
        request_id=request_id,
        version=found.scores.version,
        missing=list(found.scores.missing),
        against=found.scores.against,
        threshold=asked.threshold,
        teacher=TeacherName(name=NAME, revision=REVISION),
        feedback=told,
    )
    return FeedbackAnswer(response, tuple(questions))


def plan_id_of(trajectory: list[list[float]]) -> str:
    """What stands for a trajectory in answers: its poses, whatever numbers of JSON they came as."""
    return hash_of([[float(value) for value in pose] for pose in trajectory])[:_ID_DIGITS]


def _by_rule(plan: JudgedPlan, mode: wire_feedback.FeedbackMode) -> Feedback | RuleFeedback:
    return RuleFeedback(plan.score, plan.correct) if mode == "rule" else feedback_on(plan)


def _checked(
    written: wire_feedback.WrittenFeedback, plan: JudgedPlan, plan_id: str, pointer: str
) -> Feedback:
    """Feedback that the caller brings, once it is known to be about this plan."""
    if written.plan_id not in (None, plan_id):
        raise at(OTHER_PLAN, f"{pointer}/plan_id", f"this trajectory is {plan_id}")
    if plan.correct:
        raise at(INVALID_FEEDBACK, pointer, "the trajectory is correct: the verdict by rule is its feedback")
    try:
        parse_feedback(written.text)
    except FeedbackError as error:
        raise at(INVALID_FEEDBACK, f"{pointer}/text", str(error)) from None
    checked = check_feedback(written.text, question_of(plan))
    if not isinstance(checked, Feedback):
        kind = OTHER_PLAN if checked.check == "number" else INVALID_FEEDBACK
        raise at(kind, f"{pointer}/text", checked.detail)
    return checked


def sections_of(feedback: Feedback | RuleFeedback) -> wire_feedback.FeedbackSections | None:
    """Feedback in sections for the wire; None of a verdict by rule."""
    return wire_feedback.FeedbackSections(**asdict(feedback)) if isinstance(feedback, Feedback) else None


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, _DECIMALS)


def _fact(fact: Fact) -> wire_feedback.FailureFact:
    other = fact.other
    side: Literal["left", "right"] | None = fact.side
    return wire_feedback.FailureFact(
        sub_score=fact.sub_score,
        value=round(fact.value, _DECIMALS),
        time_s=fact.time_s,
        other=None
        if other is None
        else wire_feedback.FailureOther(
            other_id=other.other_id,
            kind=other.kind,
            now_ahead_m=_rounded(other.now_ahead_m),
            now_left_m=_rounded(other.now_left_m),
            ahead_m=_rounded(other.ahead_m),
            left_m=_rounded(other.left_m),
            gap_m=_rounded(other.gap_m),
            closing_mps=_rounded(other.closing_mps),
            speed_mps=_rounded(other.speed_mps),
        ),
        side=side,
        measures=[
            wire_feedback.FailureMeasure(
                name=each.name,
                value=round(each.value, _DECIMALS),
                limit=_rounded(each.limit),
                beyond=_rounded(each.beyond),
            )
            for each in fact.measures
        ],
    )


def _course(course: Course) -> wire_feedback.PlanCourse:
    told = {
        name: _rounded(value) if isinstance(value, float) else value for name, value in vars(course).items()
    }
    return wire_feedback.PlanCourse.model_validate(told)
