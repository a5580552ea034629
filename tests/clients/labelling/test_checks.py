from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from looktwice.clients.labelling import checks, leaks
from looktwice.clients.labelling.checks import MOST_WORDS, check_reflection
from looktwice.clients.labelling.label import CHECKS_VERSION
from looktwice.model.driving import direction, phrases
from looktwice.model.driving.direction import agrees, wanted_changes
from looktwice.model.driving.plan import Plan, track_from_words


def plan(longitudinal: str = "Keep Speed", lateral: str = "Straight", lane: str = "Keep Lane") -> Plan:
    """A plan of words; ``A|B`` changes from A to B after 3 s."""
    tracks = {}
    for group, words in (("longitudinal", longitudinal), ("lateral", lateral), ("lane", lane)):
        first, _, second = words.partition("|")
        tracks[group] = track_from_words([first] * 30 + [second or first] * 34)
    return Plan(**tracks)


LEFT = plan(lane="Left Lane Change")
FAST, SLOW = plan("Keep Speed|Accelerate"), plan("Keep Speed|Decelerate")
GOOD = (
    "The van ahead in my lane is close and its brake lights are on. Accelerating from 3.0s would close the "
    "gap, so I should ease off now and keep a safe distance."
)


def test_a_grounded_reflection_passes() -> None:
    assert check_reflection(GOOD, FAST, SLOW) == []


@pytest.mark.parametrize(
    ("text", "check"),
    [
        ("", "form"),
        ("  " + GOOD, "form"),
        (GOOD.replace(". ", ".\n"), "form"),
        (GOOD.replace(". ", ".\u2028"), "form"),
        ("- " + GOOD, "form"),
        ("1. " + GOOD, "form"),
        ("**Slow down.** " + GOOD, "form"),
        ("Reasoning: " + GOOD, "form"),
        (GOOD[:-1], "form"),
        (GOOD + " It is so." * 20, "length"),
        (GOOD.replace("The van", "As the expert knows, the van"), "leak"),
        ("Accelerating is too risky here, so I should ease off now.", "anchor"),
        ("I should ease off now and stay in my lane.", "anchor"),
        ("A van is close, so I should ease off now. Going on is unsafe, so I should also wait.", "anchor"),
        ("The lane ahead is clear, so I should speed up.", "direction"),
    ],
)
def test_what_is_wrong_is_named(text: str, check: str) -> None:
    assert check in {failed.check for failed in check_reflection(text, FAST, SLOW)}


def test_a_reflection_in_phrases_is_checked_by_its_facts() -> None:
    def failed(text: str, predicted: Plan, expert: Plan) -> list[str]:
        return [each.check for each in check_reflection(text, predicted, expert)]

    slow = str(phrases.Statement(phrases.Bend("left", 20), "too fast", "slower"))
    stay = str(phrases.Statement(phrases.Clear(), "unnecessary", "keep_lane"))
    assert failed(slow, FAST, SLOW) == []
    # It may leave out a track.
    assert failed(slow, FAST, plan("Keep Speed|Decelerate", lane="Left Lane Change")) == []
    assert failed(slow, SLOW, FAST) == ["direction"]
    assert failed(f"{slow} {stay}", FAST, SLOW) == ["direction"]
    assert failed(phrases.NOTHING, FAST, FAST) == []
    assert failed(phrases.NOTHING, FAST, SLOW) == ["direction"]


def test_the_limit_is_eighty_words() -> None:
    filler = GOOD + " It is so." * ((MOST_WORDS - len(GOOD.split())) // 3)
    while len(filler.split()) < MOST_WORDS:
        filler = "Well " + filler
    assert len(filler.split()) == MOST_WORDS
    assert check_reflection(filler, FAST, SLOW) == []
    assert [failed.check for failed in check_reflection("Well " + filler, FAST, SLOW)] == ["length"]


def test_an_answer_without_end_is_not_looked_at() -> None:
    """All the checks would take minutes for it."""
    failed = check_reflection("accelerate, " * 80_000, FAST, SLOW)
    assert [each.check for each in failed] == ["length"]


@pytest.mark.parametrize(
    ("text", "before", "after"),
    [
        ("The car ahead brakes, so slow down.", FAST, SLOW),
        ("With a queue ahead, accelerating would be unsafe.", FAST, SLOW),
        ("The road is clear; braking for so long is unnecessary, pick up speed instead.", SLOW, FAST),
        ("The junction is free and waiting on would block the traffic, so pull away.", plan("Wait"), FAST),
        ("The road bends left, so turn left.", plan(), plan(lateral="Left Turn")),
        ("The road runs straight, so turning right is wrong.", plan(lateral="Right Turn"), plan()),
        ("Cones close my lane, so change to the left lane.", plan(), plan(lane="Left Lane Change")),
        ("A car is beside me, so stay in this lane.", plan(lane="Right Lane Change"), plan()),
        ("All looks fine on this road.", plan(), plan()),
        ("The road bends left and a car moves to the right lane, so I should slow down.", FAST, SLOW),
        ("A car brakes ahead, so I should slow down and stay in my lane.", FAST, SLOW),
        ("A truck is slow, so I should change to the left lane to pass the slow truck.", plan(), LEFT),
        (
            "A bus blocks my lane, the traffic behind it brakes. I should change to the left lane.",
            plan(),
            LEFT,
        ),
        ("A car turns, so I should brake because it is turning left.", FAST, SLOW),
        ("There is a stop sign, so I should ease off before the road curves right.", FAST, SLOW),
        (
            "The van ahead brakes, so I should keep slowing down and turn left.",
            SLOW,
            plan("Keep Speed|Decelerate", lateral="Left Turn"),
        ),
        ("A van brakes ahead, so I should slow down.", SLOW, SLOW),
        (
            "A car is slower than I am in my lane, so I should move to the left lane.",
            plan(),
            plan("Accelerate", lane="Left Lane Change"),
        ),
        (
            "A curve begins right ahead, so I should slow down.",
            FAST,
            plan("Keep Speed|Decelerate", lateral="Left Turn"),
        ),
    ],
)
def test_texts_that_go_the_way_of_the_plan_agree(text: str, before: Plan, after: Plan) -> None:
    assert agrees(text, before, after)


@pytest.mark.parametrize(
    ("text", "before", "after"),
    [
        ("The road is clear, so accelerate.", FAST, SLOW),
        ("A car brakes ahead, so slow down.", SLOW, FAST),
        ("The road bends right, so turn right.", plan(), plan(lateral="Left Turn")),
        ("The road is wide and empty.", FAST, SLOW),
        ("Cones close the right, so stay in this lane.", plan(), plan(lane="Left Lane Change")),
        ("Change to the right lane, it is free.", plan(), plan(lane="Left Lane Change")),
        (
            "A van is ahead, so slow down and stay in this lane.",
            FAST,
            plan("Decelerate", lane="Left Lane Change"),
        ),
        ("A car brakes ahead, so I should slow down and change to the left lane.", FAST, SLOW),
        ("A car brakes ahead, so slow down and turn right.", FAST, SLOW),
        ("A car brakes ahead. Therefore, slow down and turn right.", FAST, SLOW),
        ("A car brakes ahead. Slow down, then gently steer to the left.", FAST, SLOW),
        ("All looks fine on this road, so I should accelerate.", plan(), plan()),
    ],
)
def test_texts_that_go_another_way_do_not(text: str, before: Plan, after: Plan) -> None:
    assert not agrees(text, before, after)


def test_short_differences_ask_for_nothing() -> None:
    nearly = Plan(longitudinal=track_from_words(["Keep Speed"] * 60 + ["Decelerate"] * 4))
    assert wanted_changes(Plan(longitudinal=track_from_words(["Keep Speed"] * 64)), nearly) == []
    assert wanted_changes(FAST, SLOW) == [{"slower"}]
    both = wanted_changes(plan(lane="Left Lane Change"), plan("Accelerate", lane="Right Lane Change"))
    assert both == [{"faster"}, {"lane_right"}]


def test_other_checks_have_another_version() -> None:
    """What was checked otherwise does not count as done: a label's key holds the version."""
    sources = [Path(str(module.__file__)).read_bytes() for module in (checks, direction, leaks, phrases)]
    digest = hashlib.sha256(b"".join(sources)).hexdigest()[:12]
    told = "raise CHECKS_VERSION if these ask for something else now, and tell both here"
    assert (CHECKS_VERSION, digest) == (5, "5c2c3d78907b"), told
