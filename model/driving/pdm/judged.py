"""A plan that was scored, with all that a teacher is told of it, and the numbers that feedback may name."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

from looktwice.model.driving.pdm.comfort import Version
from looktwice.model.driving.pdm.course import Course
from looktwice.model.driving.pdm.failures import Fact, Other
from looktwice.model.driving.pdm.feedback import SECTIONS, Feedback
from looktwice.model.driving.pdm.world import STEP_S, STEPS

Unit = Literal["m", "s", "m/s", "m/s2", "m/s3", "rad", "rad/s", "rad/s2", "deg", "%", ""]
THRESHOLD: Final = 0.8
"""ELF-VLA section 9.1 and table 10."""
HORIZON_S: Final = STEPS * STEP_S


class Measurement(NamedTuple):
    """A number that is a fact, in a unit; "" for scores and shares."""

    value: float
    unit: Unit


class Waypoint(NamedTuple):
    """Where a plan is at a time, in the ego frame of now."""

    time_s: float
    x_m: float
    y_m: float


@dataclass(frozen=True, eq=False)
class JudgedPlan:
    """A plan, what it is worth, and why.

    Attributes:
        version: whose rules.
        score: that it is judged by: its score, or, where sub-scores are missing, its partial score.
        is_partial: which of the two.
        threshold: from which score on a plan is correct.
        sub_scores: None where they are not known.
        facts: what it fails at.
        acceleration_mps2: of the ego now.
        course, waypoints: of the plan.
        true_course, true_waypoints: of the ground truth; None and empty without one.
        command: where the ego is to go, in the caller's words.
        words: the plan in words, as its planner wrote it.
        think: its planner's reasoning.
    """

    version: Version
    score: float
    is_partial: bool
    threshold: float
    sub_scores: Mapping[str, float | None]
    facts: tuple[Fact, ...]
    acceleration_mps2: float
    course: Course
    waypoints: tuple[Waypoint, ...]
    true_course: Course | None = None
    true_waypoints: tuple[Waypoint, ...] = ()
    command: str | None = None
    words: str | None = None
    think: str | None = None

    @property
    def correct(self) -> bool:
        """Whether the score is at least the threshold; what equals it, the paper leaves open."""
        return self.score >= self.threshold

    @property
    def end_off_m(self) -> float | None:
        """From the plan's last waypoint to the ground truth's."""
        if not self.true_waypoints:
            return None
        (_, x, y), (_, true_x, true_y) = self.waypoints[-1], self.true_waypoints[-1]
        return math.hypot(x - true_x, y - true_y)

    @property
    def names(self) -> tuple[str, ...]:
        """What others are called, in which digits are no numbers."""
        return tuple(called(fact.other) for fact in self.facts if fact.other is not None)


def called(other: Other) -> str:
    """What a teacher calls another: ``#`` and its id, so that no id is taken for a number."""
    return f"#{other.other_id}"


_SUFFIXES: Final[Mapping[str, Unit]] = {
    "_mps3": "m/s3",
    "_mps2": "m/s2",
    "_mps": "m/s",
    "_rad_s2": "rad/s2",
    "_rad_s": "rad/s",
    "_rad": "rad",
    "_m": "m",
    "_s": "s",
    "_share": "",
}


def numbers(judged: JudgedPlan) -> tuple[Measurement, ...]:
    """Every number that feedback may name: scores, facts, courses, waypoints; angles in degrees too."""
    return tuple(dict.fromkeys(_numbers(judged)))


def _numbers(judged: JudgedPlan) -> Iterator[Measurement]:
    for value in (judged.score, judged.threshold, 0.0, 1.0, *judged.sub_scores.values()):
        if value is not None:
            yield from _in_units(value, "")
    yield Measurement(HORIZON_S, "s")
    yield Measurement(judged.acceleration_mps2, "m/s2")
    for fact in judged.facts:
        if fact.time_s is not None:
            yield Measurement(fact.time_s, "s")
        yield from _fields(fact.other)
        for measure in fact.measures:
            for value in (measure.value, measure.limit, measure.beyond):
                if value is not None:
                    yield from _in_units(value, _unit(measure.name))
    for course in (judged.course, judged.true_course):
        yield from _fields(course)
    for waypoint in (*judged.waypoints, *judged.true_waypoints):
        yield from (
            Measurement(waypoint.time_s, "s"),
            Measurement(waypoint.x_m, "m"),
            Measurement(waypoint.y_m, "m"),
        )
    for one, true in zip(judged.waypoints, judged.true_waypoints, strict=False):
        yield from (Measurement(one.x_m - true.x_m, "m"), Measurement(one.y_m - true.y_m, "m"))
    if judged.end_off_m is not None:
        yield Measurement(judged.end_off_m, "m")


def _fields(record: object) -> Iterator[Measurement]:
    for name, value in vars(record).items() if record is not None else ():
        if isinstance(value, float):
            yield from _in_units(value, _unit(name))


def _unit(name: str) -> Unit:
    return next((unit for suffix, unit in _SUFFIXES.items() if name.endswith(suffix)), "")


def _in_units(value: float, unit: Unit) -> Iterator[Measurement]:
    yield Measurement(value, unit)
    if unit == "":
        yield Measurement(100 * value, "%")
    elif unit == "rad":
        yield Measurement(math.degrees(value), "deg")


_NUMBER: Final = re.compile(
    r"(?<![\w.])[-+\u2212]?(\d+(?:\.\d+)?)(?:\s*(?:-\s*)?("
    r"m/s\^?[23\u00b2\u00b3]|m/s|met(?:er|re)s? per second squared|met(?:er|re)s? per second|"
    r"rad/s\^?[2\u00b2]|rad/s|rad(?:ians?)?|deg(?:rees?)?|\u00b0|met(?:er|re)s?|m|sec(?:ond)?s?|s|"
    r"%|percent|per ?cent)(?![\w/]))?"
)
_UNITS: Final[Mapping[str, Unit]] = {
    **{"m/s2": "m/s2", "m/s3": "m/s3", "m/s": "m/s", "rad/s2": "rad/s2", "rad/s": "rad/s"},
    **{"\u00b0": "deg", "%": "%", "m": "m", "s": "s"},
}
_NAMES: Final = re.compile(r"\bCIPO-[12]\b|\bv[12]\.[12]\b", re.IGNORECASE)
_GROUPED: Final = re.compile(r"(?<!\d)\d{1,3}(?:,\d{3})+(?!\d)")
_SQUARES: Final = "\u00b2\u00b3"
_WORDS: Final = re.compile(
    r"\b(?:three|four|five|six|seven|eight|nine|ten|eleven|twelve|(?:thir|four|fif|six|seven|eigh|nine)teen|"
    r"twenty|thirty|forty|fifty|sixty|seventy|eighty|ninety|hundreds?|thousands?|dozens?|half|halve|quarter|"
    r"thirds?|double|twice|triple)\b",
    re.IGNORECASE,
)


def foreign_numbers(
    feedback: Feedback, allowed: Iterable[Measurement], names: Iterable[str] = ()
) -> list[str]:
    """Numbers in a teacher's sections that are no facts, as they are written there, each once.

    A number is a fact when one of ``allowed`` rounds to it, signs apart: to as many decimals as are written,
    and in the unit that is written behind it, where there is one. Numbers in words are never taken: they
    could not be held against anything.

    Args:
        feedback: what was written.
        allowed: what is known, see `numbers`.
        names: of others, left out.
    """
    known = tuple(allowed)
    text = " ".join(getattr(feedback, field) for field in SECTIONS)
    for name in sorted(names, key=len, reverse=True):
        text = re.sub(rf"{re.escape(name)}(?!\w)", "that one", text)
    text = _NAMES.sub("that one", text)
    found = [each[0] for pattern in (_WORDS, _GROUPED) for each in pattern.finditer(text)]
    found += [letter for letter in text if _is_other_number(letter) and letter not in _SQUARES]
    # Whatever holds a digit that is no part of a plain number is no number that can be compared.
    plain = _NUMBER.sub(lambda each: " " * len(each[0]), text)
    found += [word for word in plain.split() if any(each.isdecimal() for each in word)]
    found += [
        each[0].strip() for each in _NUMBER.finditer(text) if not _is_known(each[1], _unit_of(each[2]), known)
    ]
    return list(dict.fromkeys(found))


def _is_other_number(letter: str) -> bool:
    return unicodedata.category(letter) in ("Nl", "No") or (letter.isdigit() and not letter.isascii())


def _unit_of(written: str | None) -> Unit | None:
    """The unit that is written behind a number; None where there is none."""
    if not written:
        return None
    plain = written.replace("^", "").replace("\u00b2", "2").replace("\u00b3", "3")
    if plain in _UNITS:
        return _UNITS[plain]
    if plain.startswith("met"):
        return "m/s2" if plain.endswith("squared") else "m/s" if plain.endswith("second") else "m"
    return "s" if plain.startswith("sec") else "rad" if plain.startswith("rad") else (
        "deg" if plain.startswith("deg") else "%"
    )  # fmt: skip


def _is_known(digits: str, unit: Unit | None, known: Iterable[Measurement]) -> bool:
    decimals = len(digits.partition(".")[2])
    value, half = float(digits), 0.5 * 10.0**-decimals
    return any(
        abs(abs(number.value) - value) <= half + 1e-9 for number in known if unit in (None, number.unit)
    )
