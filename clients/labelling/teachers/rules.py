"""The built-in teacher: says what is wrong with a plan from a scene's annotations, as far as cameras show it.

It knows which plan is better and uses that to choose what to talk about; what it says is in the view of the
front cameras (`looktwice.model.driving.view`), or about the plan itself. Its reflections are facts in phrases
(`looktwice.model.driving.phrases`): one statement for each track that is to change and for whose change
something is to be seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from looktwice.clients.labelling.checks import FailedCheck
from looktwice.clients.labelling.teachers.teacher import AnnotationsMissing, Answer, NothingInView, Question
from looktwice.model.driving.direction import Change, wanted_changes
from looktwice.model.driving.phrases import Facts, Statement
from looktwice.model.driving.plan import TICKS, Plan
from looktwice.model.driving.reasons import reason
from looktwice.model.driving.view import View, view_of


class RuleTeacher:
    """`looktwice.clients.labelling.teachers.teacher.Teacher` by rule; nothing is asked of anybody."""

    name: Final = "rules"
    revision: Final = "7"

    async def reflect(self, question: Question, complaints: Sequence[FailedCheck] = ()) -> Answer:
        """Facts in phrases; the same for the same question.

        Raises:
            AnnotationsMissing: the scene has no annotations.
            NothingInView: nothing that the cameras can show asks for what the better plan does otherwise.
        """
        if question.surroundings is None:
            raise AnnotationsMissing(
                "the built-in teacher needs the scene's annotations: agents and lane lines"
            )
        predicted, expert = question.predicted, question.expert
        view = view_of(question.scene, question.surroundings)
        changes = wanted_changes(predicted, expert)
        statements = [found for each in changes if (found := _on(each, view, predicted, expert)) is not None]
        if changes and not statements:
            wanted = ", ".join(min(each) for each in changes)
            raise NothingInView(f"nothing in view asks for another plan ({wanted})")
        return Answer(str(Facts(tuple(statements))))

    async def close(self) -> None:
        """There is nothing to close."""


def _on(changes: frozenset[Change], view: View, predicted: Plan, expert: Plan) -> Statement | None:
    """What is to be seen that asks for one of the changes of a track; None where nothing is."""
    stops = expert.word_at("longitudinal", TICKS - 1) == "Wait"
    moves_left = any(action.word == "Left Lane Change" for action in predicted.lane or ())
    told = (
        reason(change, view, stops=stops, moves="left" if moves_left else "right")
        for change in sorted(changes)
    )
    return next((each for each in told if each is not None), None)
