"""The built-in teacher: says what is wrong with a plan from a scene's annotations, as far as cameras show it.

It knows which plan is better and uses that to choose what to talk about; what it says is in the view of the
front cameras (`model.driving.view`), or about the plan itself. Wordings vary by scene and draw, and by
nothing else.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Final

from clients.labelling.checks import FailedCheck
from clients.labelling.teachers.preference import remedies_first
from clients.labelling.teachers.teacher import AnnotationsMissing, Answer, NothingInView, Question
from model.driving.direction import Change, wanted_changes
from model.driving.plan import Group, Plan, format_tick
from model.driving.scene import AgentKind
from model.driving.view import Sight, View, view_of

_NAMES: Final[dict[AgentKind, tuple[str, ...]]] = {
    "vehicle": ("vehicle", "car"),
    "pedestrian": ("pedestrian", "person on foot"),
    "cone": ("traffic cone", "cone"),
    "barrier": ("barrier", "road barrier"),
}
_CLOSE_M: Final = 45.0
_STANDING_MS: Final = 0.5
_SLOWER_BY_MS: Final = 1.0


class RuleTeacher:
    """`clients.labelling.teachers.teacher.Teacher` by rule; nothing is asked of anybody."""

    name: Final = "rules"
    revision: Final = "3"

    async def reflect(self, question: Question, complaints: Sequence[FailedCheck] = ()) -> Answer:
        """One paragraph; the same for the same question, another one after complaints.

        Raises:
            AnnotationsMissing: the scene has no annotations.
            NothingInView: nothing that the cameras can show asks for what the better plan does otherwise.
        """
        if question.surroundings is None:
            raise AnnotationsMissing(
                "the built-in teacher needs the scene's annotations: agents and lane lines"
            )
        scene, predicted, expert = question.scene, question.predicted, question.expert
        chance = random.Random(f"{scene.scene_id}/{question.seed}/{len(complaints)}/{predicted}")
        view = view_of(scene, question.surroundings)
        changes = remedies_first(wanted_changes(predicted, expert), question.outcome)
        if not changes:
            return Answer(_nothing_to_change(view, chance))
        told = (_on(min(each), view, predicted, expert, chance) for each in changes)
        said = [text for text in told if text is not None][:2]
        if not said:
            raise NothingInView(f"nothing in view asks for another plan ({', '.join(map(min, changes))})")
        return Answer(" ".join(said))

    async def close(self) -> None:
        """There is nothing to close."""


def _on(change: Change, view: View, predicted: Plan, expert: Plan, chance: random.Random) -> str | None:
    """What is to be seen, what is wrong with the plan, and what is better: one change of one track.

    None where nothing is to be seen that asks for it.
    """
    if change == "slower":
        return _slower(view, predicted, expert, chance)
    if change == "faster":
        return _faster(view, predicted, chance)
    if change in ("left", "right", "straight"):
        return _turning(change, view, predicted, chance)
    return _lanes(change, view, predicted, chance)


def _slower(view: View, predicted: Plan, expert: Plan, chance: random.Random) -> str | None:
    near = view.first(
        "pedestrian", places=("my lane", "the left lane", "the right lane", "the left side", "the right side")
    )
    ahead = view.first("vehicle", "cone", "barrier", places=("my lane",))
    beside = view.first("vehicle", "cone", "barrier", places=("the left lane", "the right lane"))
    begins = _first(predicted, "longitudinal", "Accelerate")
    fast = (
        f"accelerating from {begins}s"
        if begins is not None
        else chance.choice(("keeping up this pace", "holding this speed", "going on like this"))
    )
    stands = expert.word_at("longitudinal", 63) == "Wait"
    better = (
        chance.choice(("I should brake and stop", "I should slow down and come to a stop"))
        if stands
        else chance.choice(
            (
                "I should ease off earlier",
                "I should slow down sooner",
                "I should brake gently and keep more distance",
            )
        )
    )
    if near is not None and near.ahead_m < _CLOSE_M:
        cue = f"{_a(near, chance)} is {_where(near)}, {_ahead(near.ahead_m)}."
        return f"{cue} {_capital(fast)} would leave no time to react, so {better}."
    if ahead is not None and (ahead.kind != "vehicle" or _holds_up(ahead, view)):
        cue = f"{_a(ahead, chance)} {_motion(ahead, view, chance)} in my lane, {_ahead(ahead.ahead_m)}."
        result = chance.choice(
            ("would close the gap too quickly", "would bring me too close", "could leave me no way out")
        )
        return f"{cue} {_capital(fast)} {result}, so {better}."
    if view.bend is not None:
        cue = f"A curve begins {_ahead(view.bend_m)}."
        return f"{cue} {_capital(fast)} would carry too much speed into the curve, so {better}."
    if ahead is not None:
        cue = f"{_a(ahead, chance)} is in my lane, {_ahead(ahead.ahead_m)}."
        return f"{cue} {_capital(fast)} would eat up the gap, so {better}."
    if beside is not None and beside.ahead_m < _CLOSE_M:
        cue = f"{_a(beside, chance)} is in {beside.place}, {_ahead(beside.ahead_m)}."
        return f"{cue} {_capital(fast)} would leave little room beside it, so {better}."
    return None


def _faster(view: View, predicted: Plan, chance: random.Random) -> str | None:
    ahead = view.first("vehicle", "cone", "barrier", "pedestrian", places=("my lane",))
    slow = next(
        (
            text
            for word, text in (("Wait", "waiting"), ("Decelerate", "slowing down"))
            if _first(predicted, "longitudinal", word) is not None
        ),
        "holding back the pace",
    )
    if ahead is None:
        cue = chance.choice(("My lane is clear as far as I can see.", "The road ahead in my lane is free."))
    elif ahead.ahead_m < _CLOSE_M and ahead.speed_ms < view.speed_ms - _SLOWER_BY_MS:
        return None
    elif ahead.kind == "vehicle" and ahead.speed_ms > view.speed_ms + _SLOWER_BY_MS:
        cue = f"{_a(ahead, chance)} in my lane is drawing ahead, {_ahead(ahead.ahead_m)}."
    else:
        cue = f"{_a(ahead, chance)} in my lane leaves room enough, {_ahead(ahead.ahead_m)}."
    result = chance.choice(("would be needlessly cautious", "would hold up the traffic for no reason"))
    better = chance.choice(("I should pick up speed", "it is better to accelerate", "I should drive on"))
    return f"{cue} {_capital(slow)} for so long {result}, so {better}."


def _turning(change: Change, view: View, predicted: Plan, chance: random.Random) -> str | None:
    planned = _first(predicted, "lateral", "Left Turn") or _first(predicted, "lateral", "Right Turn")
    if change == "straight":
        cue = chance.choice(("The lane runs straight on here.", "The lane markings run straight ahead."))
        if view.bend is not None:
            cue = f"My lane runs straight first, and the bend is {_ahead(view.bend_m)}."
        when = f" from {planned}s" if planned else ""
        return f"{cue} Turning{when} would take me off my line, so I should steer straight for longer."
    if view.bend == change:
        cue = f"The road bends {change} {_ahead(view.bend_m)}."
    elif change in view.turns:
        cue = chance.choice(
            (f"The junction lets me go {change} here.", f"A lane leads {change} off this road.")
        )
    else:
        return None
    result = chance.choice(("would carry me out of the lane", "would miss the way"))
    better = chance.choice((f"I should turn {change}", f"I should steer to the {change} in time"))
    return f"{cue} Going on as planned {result}, so {better}."


def _lanes(change: Change, view: View, predicted: Plan, chance: random.Random) -> str | None:
    if change == "keep_lane":
        ahead = view.first("vehicle", "cone", "barrier", "pedestrian", places=("my lane",))
        moved = "left" if _first(predicted, "lane", "Left Lane Change") is not None else "right"
        beside = _in_lane(moved, view)
        if beside is not None:
            cue = f"{_a(beside, chance)} is in {beside.place}, {_ahead(beside.ahead_m)}."
        elif ahead is None:
            cue = chance.choice(("My lane is open ahead.", "There is nothing in my lane."))
        elif ahead.kind == "vehicle" and not _holds_up(ahead, view):
            cue = f"{_a(ahead, chance)} in my lane leaves room enough, {_ahead(ahead.ahead_m)}."
        else:
            return None
        return f"{cue} Moving over would be unnecessary, so I should stay in my lane for longer."
    side = "left" if change == "lane_left" else "right"
    ahead = view.first("vehicle", "cone", "barrier", places=("my lane",))
    if ahead is not None:
        cue = f"{_a(ahead, chance)} {_motion(ahead, view, chance)} in my lane, {_ahead(ahead.ahead_m)}."
    elif side in view.beside and _in_lane(side, view) is None:
        cue = chance.choice(
            (f"There is room in the {side} lane.", f"The lane to the {side} of mine is open.")
        )
    else:
        return None
    better = chance.choice(
        (f"I should move to the {side} lane", f"I should change to the {side} lane in time")
    )
    return f"{cue} Going on here would get me stuck, so {better}."


def _nothing_to_change(view: View, chance: random.Random) -> str:
    ahead = view.first("vehicle", "cone", "barrier", "pedestrian", places=("my lane",))
    cue = (
        "My lane is clear ahead"
        if ahead is None
        else f"{_a(ahead, chance)} in my lane leaves room, {_ahead(ahead.ahead_m)}"
    )
    return f"{cue}, and what I have in mind fits the road as it runs."


def _in_lane(side: str, view: View) -> Sight | None:
    """The first thing in the lane beside mine."""
    return view.first(
        "vehicle", "cone", "barrier", places=("the left lane" if side == "left" else "the right lane",)
    )


def _holds_up(sight: Sight, view: View) -> bool:
    return sight.ahead_m < _CLOSE_M and not sight.speed_ms > view.speed_ms + _SLOWER_BY_MS


def _motion(sight: Sight, view: View, chance: random.Random) -> str:
    if sight.kind != "vehicle" or abs(sight.speed_ms) < _STANDING_MS:
        return chance.choice(("stands", "is standing"))
    if sight.speed_ms < view.speed_ms - _SLOWER_BY_MS:
        return chance.choice(("moves more slowly than I do", "is slower than I am"))
    return chance.choice(("drives", "is driving"))


def _a(sight: Sight, chance: random.Random) -> str:
    return f"A {chance.choice(_NAMES[sight.kind])}"


def _where(sight: Sight) -> str:
    return {"the left side": "on the left side", "the right side": "on the right side"}.get(
        sight.place, f"in {sight.place}"
    )


def _ahead(metres: float) -> str:
    """A distance as one can estimate it."""
    return "right ahead" if metres < 8 else f"some {5 * round(metres / 5)} metres ahead"


def _first(plan: Plan, group: Group, word: str) -> str | None:
    """When a word is said first."""
    return next(
        (format_tick(action.start) for action in plan.track(group) or () if action.word == word), None
    )


def _capital(text: str) -> str:
    return text[0].upper() + text[1:]
