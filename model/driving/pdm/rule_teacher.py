"""The built-in teacher: five sections on a failed plan, from its facts and nothing else.

Source: ELF-VLA, figures 7 and 8b: what each section speaks of.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Final

from looktwice.model.driving.pdm.course import Course
from looktwice.model.driving.pdm.failures import Fact, Other
from looktwice.model.driving.pdm.feedback import BEGIN, END, Feedback, RuleFeedback
from looktwice.model.driving.pdm.judged import HORIZON_S, JudgedPlan, called
from looktwice.model.driving.pdm.scoring import (
    COLLISIONS,
    COMFORT,
    DIRECTION,
    DRIVABLE,
    EXTENDED_COMFORT,
    LANE_KEEPING,
    LIGHTS,
    PROGRESS,
    TIME_TO_COLLISION,
)
from looktwice.model.driving.plan import PlanError, parse_plan

NAME: Final = "rules"
REVISION: Final = "1"
"""Raised when the same facts come to be told otherwise."""
SHORT: Final = {
    COLLISIONS: "NC",
    DRIVABLE: "DAC",
    DIRECTION: "DDC",
    LIGHTS: "TLC",
    PROGRESS: "EP",
    TIME_TO_COLLISION: "TTC",
    LANE_KEEPING: "LK",
    COMFORT: "C",
    EXTENDED_COMFORT: "EC",
}
_SAFETY: Final = (COLLISIONS, DRIVABLE, DIRECTION, LIGHTS)
_EFFICIENCY: Final = (TIME_TO_COLLISION, PROGRESS, LANE_KEEPING, COMFORT, EXTENDED_COMFORT)
_LONGITUDINAL: Final = {
    "stop": r"(?:stop|stopping|halt|wait)\b",
    "decelerate": r"decelerat|slow(?:ing)? down|slowing|brak(?:e|ing)\b(?! light)|ease off|yield",
    "accelerate": r"accelerat|speed(?:ing)? up|go faster",
    "maintain speed": r"(?:keep|maintain|hold)\w* (?:the |my |this |a |its )?(?:\w+ )?(?:speed|velocity)",
}
_PLANNED: Final = {
    "Accelerate": "accelerate",
    "Decelerate": "decelerate",
    "Keep Speed": "maintain speed",
    "Wait": "stop",
}
"""Words of the plan language."""
_HORIZON_TICKS: Final = round(HORIZON_S * 10)
_SEEN: Final = {
    "vehicle": r"vehicle|car\b|cars\b|truck|van\b|bus\b|leader|traffic|cut.?in|oncoming",
    "pedestrian": r"pedestrian|person|people|walker|child",
    "bicycle": r"bicycle|cyclist|bike|rider",
    "road": r"road (?:edge|boundar|border)|boundar|kerb|curb|edge|shoulder|off.?road|drivable|bend|curve",
    "red light": r"light|signal",
}
_THINGS: Final = r"cone|barrier|obstacle|object|construction|static|road user"
_BOUNDS: Final = {
    "mps2": "m/s\u00b2",
    "mps3": "m/s\u00b3",
    "rad_s2": "rad/s\u00b2",
    "rad_s": "rad/s",
}


def feedback_on(judged: JudgedPlan) -> Feedback | RuleFeedback:
    """ELF-VLA section 7.2: sections on what is wrong, the verdict on what is correct."""
    return RuleFeedback(judged.score, correct=True) if judged.correct else rule_sections(judged)


def verdict_with_truth(judged: JudgedPlan) -> str:
    """The verdict by rule, and behind it what the human did, where that is known (section 9.1, Rule-GRPO)."""
    verdict = str(RuleFeedback(judged.score, judged.correct))
    if not judged.true_waypoints:
        return verdict
    truth = ", ".join(f"[{x:.2f}, {y:.2f}]" for _, x, y in judged.true_waypoints)
    return f"{verdict} The correct trajectory is {truth}."


def rule_sections(judged: JudgedPlan) -> Feedback:
    """The sections on a plan; the same for the same facts."""
    return Feedback(
        *map(
            " ".join,
            (
                _meta_action(judged),
                _think_process(judged),
                _safety(judged),
                _efficiency(judged),
                _mend(judged),
            ),
        )
    )


def _meta_action(judged: JudgedPlan) -> Iterator[str]:
    course, truth = judged.course, judged.true_course
    yield f"The plan is to {course.longitudinal} and {course.lateral}: {_way(course)}."
    meant = _meant(judged)
    if meant and course.longitudinal not in meant:
        yield f"Its words ask to {' or to '.join(meant)}, and the trajectory does not do that."
    if truth is None:
        yield "No ground truth is known to compare it with."
        return
    wrong = [
        f"to {right} instead of to {own}"
        for own, right in ((course.longitudinal, truth.longitudinal), (course.lateral, truth.lateral))
        if own != right
    ]
    if wrong:
        yield f"The right action is {' and '.join(wrong)}: {_way(truth)}."
        return
    yield "This action matches the ground truth, so that its execution is at fault and not the choice."


def _think_process(judged: JudgedPlan) -> Iterator[str]:
    causes = list(_causes(judged))
    think = judged.think or ""
    if not think.strip():
        yield "No reasoning was given."
    if not causes:
        yield "Nothing around the car is the reason of the failure; the way of driving is."
    for kind, told in causes:
        if not think.strip():
            yield f"It has to name {told}."
        elif re.search(_SEEN.get(kind, _THINGS), think, re.IGNORECASE):
            yield f"The reasoning speaks of it, and yet does not draw the conclusion: mind {told}."
        else:
            yield f"The reasoning overlooks what leads to the failure: pay attention to {told}."


def _causes(judged: JudgedPlan) -> Iterator[tuple[str, str]]:
    """What the reasoning has to speak of: a kind, and how it is told; each once."""
    told = set()
    for fact in judged.facts:
        if fact.other is not None and fact.other.other_id not in told:
            told.add(fact.other.other_id)
            yield fact.other.kind, _name(fact.other) + _now(fact.other)
    if (off_road := _fact(judged, DRIVABLE)) is not None:
        yield "road", f"the edge of the road{_on(off_road)}"


def _safety(judged: JudgedPlan) -> Iterator[str]:
    for name in _SAFETY:
        fact = _fact(judged, name)
        if fact is None:
            if judged.sub_scores.get(name) is not None and name in (COLLISIONS, DRIVABLE):
                fine = (
                    "there is no collision by the plan's fault"
                    if name == COLLISIONS
                    else "the car stays on the road"
                )
                yield f"{SHORT[name]} is 1.0: {fine}."
            continue
        yield f"{SHORT[name]} is {fact.value:.1f}: {_why(fact)}."
    if all(judged.sub_scores.get(name) is None for name in _SAFETY):
        yield "Nothing is known of safety: the labels lack what it is scored by."


def _efficiency(judged: JudgedPlan) -> Iterator[str]:
    failed = [fact for name in _EFFICIENCY if (fact := _fact(judged, name)) is not None]
    for fact in failed:
        yield f"{SHORT[fact.sub_score]} is {fact.value:.2f}: {_why(fact)}."
    if not failed:
        yield "None of the sub-scores that are known is lowered."


def _why(fact: Fact) -> str:
    when = "" if fact.time_s is None else f"at {fact.time_s:.1f} s "
    match fact.sub_score:
        case "no_at_fault_collisions":
            return f"{when}the car hits {_name(fact.other)}{_closing(fact.other)}"
        case "drivable_area_compliance":
            most = fact.measure("most_off_road_m")
            by = "" if most is None else f", by up to {most.value:.2f} m"
            return f"{when}the car leaves the road{_on(fact)}{by}"
        case "driving_direction_compliance":
            metres = fact.measure("against_traffic_m")
            by = "" if metres is None else f", {metres.value:.1f} m within a second"
            return f"{when}the car is in no lane of the route{by}"
        case "traffic_light_compliance":
            return f"{when}the car is behind a red light"
        case "time_to_collision":
            left = fact.measure("time_to_collision_s")
            by = "" if left is None else f", {left.value:.1f} s before it would hit it"
            return f"{when}the car comes too close to {_name(fact.other)}{_then(fact.other)}{by}"
        case "ego_progress":
            return _progress(fact)
        case "lane_keeping":
            beside = fact.measure("beside_line_m")
            by = "" if beside is None else f", {beside.value:.2f} m{_on(fact)}"
            return f"{when}the car has long been beside the centre line{by}"
        case "comfort":
            told = ", ".join(_bound(each.name, each.value, each.limit) for each in fact.measures)
            return f"{when}the ride is too rough" + (f": {told}" if told else "")
        case _:
            told = ", ".join(_bound(each.name, each.value, each.limit) for each in fact.measures)
            return "the plan departs too much from the plan before" + (f": {told}" if told else "")


def _progress(fact: Fact) -> str:
    progress, missing = fact.measure("progress_m"), fact.measure("missing_share")
    if progress is None:
        return "the car makes too little progress"
    if progress.limit is None or missing is None:
        return f"the {progress.value:.1f} m driven do not count, since the plan is not safe"
    return (
        f"the car gets {progress.value:.1f} m along the route instead of {progress.limit:.1f} m, "
        f"{100 * missing.value:.0f} % less"
    )


def _mend(judged: JudgedPlan) -> Iterator[str]:
    told: dict[str, None] = {}
    for fact in judged.facts:
        told |= dict.fromkeys(_steps(fact, judged))
    yield from told
    truth = judged.true_course
    if truth is not None:
        _, x, y = judged.true_waypoints[-1]
        yield (
            f"Drive at {truth.mean_speed_mps:.1f} m/s on average and be at [{x:.2f}, {y:.2f}] "
            f"after {HORIZON_S:.1f} s."
        )
    elif not told:
        yield "Keep the plan."


def _steps(fact: Fact, judged: JudgedPlan) -> Iterator[str]:
    """What to do about a fact, in sentences."""
    before = "" if fact.time_s is None else f" before {fact.time_s:.1f} s"
    match fact.sub_score:
        case "no_at_fault_collisions" | "time_to_collision" if fact.other is not None:
            yield _avoid(fact.other, before)
        case "drivable_area_compliance" | "lane_keeping":
            back = {"left": "right", "right": "left"}.get(fact.side or "", "middle of the road")
            yield f"Steer more to the {back}{before}."
        case "driving_direction_compliance":
            yield "Stay in the lanes of the route."
        case "traffic_light_compliance":
            yield "Stop before the red light."
        case "ego_progress" if (missing := fact.measure("missing_share")) is not None:
            if not any(_fact(judged, name) for name in (COLLISIONS, TIME_TO_COLLISION)) and missing.value > 0:
                yield "Drive on faster along the route."
        case "comfort":
            yield "Brake, accelerate and steer more smoothly."
        case "extended_comfort":
            yield "Stay closer to the plan made before."


def _avoid(other: Other, before: str) -> str:
    if other.ahead_m is not None and other.left_m is not None and abs(other.left_m) > abs(other.ahead_m):
        side = "right" if other.left_m > 0 else "left"
        return f"Keep more to the {side}{before}, away from {_name(other)}."
    if other.ahead_m is not None and other.ahead_m < 0:
        return f"Leave {_name(other)} room behind{before}."
    return f"Brake{before} and stay behind {_name(other)}."


def _way(course: Course) -> str:
    return (
        f"from {course.speed_mps:.1f} m/s to {course.end_speed_mps:.1f} m/s, "
        f"ending {_place(course.ahead_m, course.left_m)} after {HORIZON_S:.1f} s"
    )


def _place(ahead_m: float, left_m: float) -> str:
    along, side = "ahead" if ahead_m >= 0 else "behind", "left" if left_m >= 0 else "right"
    return f"{abs(ahead_m):.2f} m {along} and {abs(left_m):.2f} m to the {side}"


def _now(other: Other) -> str:
    if other.now_ahead_m is None or other.now_left_m is None:
        return ""
    return f", now {_place(other.now_ahead_m, other.now_left_m)}"


def _then(other: Other | None) -> str:
    if other is None or other.ahead_m is None or other.left_m is None:
        return ""
    return f", then {_place(other.ahead_m, other.left_m)}"


def _closing(other: Other | None) -> str:
    if other is None or other.closing_mps is None:
        return ""
    return f", closing in at {other.closing_mps:.1f} m/s" if other.closing_mps > 0 else ""


def _name(other: Other | None) -> str:
    if other is None:
        return "another"
    # Ids are callers' words: one that would break the text stays out of it.
    name = called(other)
    is_plain = name.isprintable() and not re.search(r"\s\s|\s$|^#\s", name)
    is_plain = is_plain and BEGIN not in name and END not in name
    return f"the {other.kind} {name}" if is_plain else f"the {other.kind}"


def _bound(name: str, value: float, limit: float | None) -> str:
    suffix = next(each for each in sorted(_BOUNDS, key=len, reverse=True) if name.endswith(each))
    what = name.removesuffix(f"_{suffix}").replace("_", " ")
    return f"{what} of {value:.2f} {_BOUNDS[suffix]}" + (
        "" if limit is None else f" where {limit:.2f} {_BOUNDS[suffix]} is the limit"
    )


def _on(fact: Fact) -> str:
    return "" if fact.side is None else f" on the {fact.side}"


def _fact(judged: JudgedPlan, name: str) -> Fact | None:
    return next((fact for fact in judged.facts if fact.sub_score == name), None)


def _meant(judged: JudgedPlan) -> tuple[str, ...]:
    """What reasoning and plan ask for within the horizon, as high-level actions of speed; all they name."""
    found = {
        action
        for action, pattern in _LONGITUDINAL.items()
        if re.search(rf"\b(?:{pattern})", judged.think or "", re.IGNORECASE)
    }
    try:
        track = () if judged.words is None else parse_plan(judged.words).longitudinal or ()
    except PlanError:
        track = ()
    found |= {_PLANNED[each.word] for each in track if each.start < _HORIZON_TICKS and each.word in _PLANNED}
    return tuple(action for action in _LONGITUDINAL if action in found)
