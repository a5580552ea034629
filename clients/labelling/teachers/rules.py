"""The built-in teacher: says what is wrong with a plan from a scene's annotations, as far as cameras show it.

It knows which plan is better and uses that to choose what to talk about; what it says is in the view of the
front cameras (`model.driving.view`), or about the plan itself. Its reflections are facts in phrases
(`model.driving.phrases`): one statement for each track that is to change and for whose change something is to
be seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from clients.labelling.checks import FailedCheck
from clients.labelling.teachers.teacher import AnnotationsMissing, Answer, NothingInView, Question
from model.driving.claims import CLEAR_WITHIN_M
from model.driving.direction import Change, wanted_changes
from model.driving.phrases import (
    FARTHEST_M,
    STEP_M,
    Bend,
    Clear,
    Consequence,
    Facts,
    Junction,
    Room,
    Side,
    Statement,
    Straight,
    Thing,
)
from model.driving.plan import TICKS, Plan
from model.driving.seen import LANES, SLOWER_BY_MS, STANDING_MS, is_clear, spot_of, state_of
from model.driving.view import Place, Sight, View, view_of

_CLOSE_M: Final = CLEAR_WITHIN_M
_NO_TIME_M: Final = {"pedestrian": 25.0, "vehicle": 12.0, "cone": 12.0, "barrier": 12.0}
"""Nearer than this there is no time to react."""
_WALKERS: Final[tuple[Place, ...]] = (
    *("my lane", "the left lane", "the right lane"),
    *("the left side", "the right side"),
)


class RuleTeacher:
    """`clients.labelling.teachers.teacher.Teacher` by rule; nothing is asked of anybody."""

    name: Final = "rules"
    revision: Final = "5"

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
    told = (_statement(change, view, predicted, expert) for change in sorted(changes))
    return next((each for each in told if each is not None), None)


def _statement(change: Change, view: View, predicted: Plan, expert: Plan) -> Statement | None:
    match change:
        case "slower":
            return _slower(view, stands=expert.word_at("longitudinal", TICKS - 1) == "Wait")
        case "faster":
            return _faster(view)
        case "straight":
            cue = Straight() if view.bend is None else _bend(view.bend, view)
            return Statement(cue, "out of lane", change)
        case "left" | "right":
            if view.bend == change:
                return Statement(_bend(change, view), "out of lane", change)
            return Statement(Junction(change), "wrong way", change) if change in view.turns else None
        case "lane_left" | "lane_right":
            return _other_lane("left" if change == "lane_left" else "right", view)
        case "keep_lane":
            return _same_lane(view, predicted)


def _slower(view: View, *, stands: bool) -> Statement | None:
    walker = view.first("pedestrian", places=_WALKERS)
    ahead = _ahead(view)
    beside = view.first("vehicle", "cone", "barrier", places=tuple(LANES.values()))
    if walker is not None and walker.ahead_m < _CLOSE_M:
        return _brake_for(walker, view, stands=stands)
    if ahead is None or not _holds_up(ahead, view):
        if view.bend is not None:
            return Statement(_bend(view.bend, view), "too fast", "slower")
        if ahead is None:
            ahead = beside if beside is not None and beside.ahead_m < _CLOSE_M else None
    return None if ahead is None else _brake_for(ahead, view, stands=stands)


def _brake_for(sight: Sight, view: View, *, stands: bool) -> Statement:
    consequence: Consequence = "no time" if sight.ahead_m < _NO_TIME_M[sight.kind] else "too close"
    return Statement(_thing(sight, view), consequence, "stop" if stands else "slower")


def _faster(view: View) -> Statement | None:
    if is_clear(view, "my lane"):
        return Statement(Clear(), "too cautious", "faster")
    ahead = view.first("vehicle", "cone", "barrier", "pedestrian", places=("my lane",))
    if ahead is None or not _leaves_room(ahead, view):
        return None
    return Statement(_thing(ahead, view), "too cautious", "faster")


def _same_lane(view: View, predicted: Plan) -> Statement | None:
    moves_left = any(action.word == "Left Lane Change" for action in predicted.lane or ())
    beside = view.first("vehicle", "cone", "barrier", places=(LANES["left" if moves_left else "right"],))
    if beside is not None and beside.ahead_m < _CLOSE_M:
        return Statement(_thing(beside, view), "too close", "keep_lane")
    if is_clear(view, "my lane"):
        return Statement(Clear(), "unnecessary", "keep_lane")
    ahead = view.first("vehicle", "cone", "barrier", "pedestrian", places=("my lane",))
    if ahead is None or ahead.kind != "vehicle" or _holds_up(ahead, view):
        return None
    return Statement(_thing(ahead, view), "unnecessary", "keep_lane")


def _other_lane(side: Side, view: View) -> Statement | None:
    change: Change = "lane_left" if side == "left" else "lane_right"
    if (ahead := _ahead(view)) is not None:
        return Statement(_thing(ahead, view), "stuck", change)
    if side in view.beside and is_clear(view, LANES[side]):
        return Statement(Room(side), "stuck", change)
    return None


def _ahead(view: View) -> Sight | None:
    """The nearest thing that blocks the own lane."""
    return view.first("vehicle", "cone", "barrier", places=("my lane",))


def _leaves_room(sight: Sight, view: View) -> bool:
    """Whether one may pick up speed behind it: it drives, does not brake, and is far or drives off."""
    if sight.kind != "vehicle" or sight.speed_ms < STANDING_MS or sight.brakes:
        return False
    faster_ms = sight.speed_ms - view.speed_ms
    return faster_ms > SLOWER_BY_MS or (faster_ms > -SLOWER_BY_MS and sight.ahead_m > _NO_TIME_M[sight.kind])


def _holds_up(sight: Sight, view: View) -> bool:
    if sight.kind != "vehicle":
        return True
    return sight.ahead_m < _CLOSE_M and not sight.speed_ms > view.speed_ms + SLOWER_BY_MS


def _thing(sight: Sight, view: View) -> Thing:
    return Thing(sight.kind, spot_of(sight), _grid(sight.ahead_m), state_of(sight, view))


def _bend(side: Side, view: View) -> Bend:
    return Bend(side, _grid(view.bend_m) or None)


def _grid(metres: float) -> int:
    """A distance as one can estimate it."""
    return min(FARTHEST_M, STEP_M * round(metres / STEP_M))
