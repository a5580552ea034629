from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.direction import (
    CHANGES,
    changed,
    group_of,
    track_changes,
    wanted_changes,
)
from looktwice.model.driving.phrases import (
    NOTHING,
    Bend,
    Clear,
    Facts,
    PhraseError,
    Room,
    Statement,
    Thing,
    agrees,
    corrected,
    facts_of,
    read_facts,
)
from looktwice.model.driving.plan import GROUPS, Plan, parse_plan, track_from_words
from tests.model.driving.strategies import facts
from tests.model.formats.strategies import plans

SLOWER = Statement(Thing("vehicle", "my lane", 25, "standing"), "too close", "slower")
STAY = Statement(Clear(), "unnecessary", "keep_lane")


def plan(longitudinal: str = "Keep Speed", lateral: str = "Straight", lane: str = "Keep Lane") -> Plan:
    words = {"longitudinal": longitudinal, "lateral": lateral, "lane": lane}
    return parse_plan("".join(f"- {group}\n  - 0.0s-6.4s: {word}\n" for group, word in words.items()))


@given(facts())
def test_facts_are_read_back_from_their_text(facts: Facts) -> None:
    assert read_facts(str(facts)) == facts


@given(facts())
def test_facts_mirrored_twice_are_the_same(facts: Facts) -> None:
    mirrored = facts.mirrored()
    assert mirrored.mirrored() == facts
    swapped = str(facts).replace("left", "RIGHT").replace("right", "left").replace("RIGHT", "right")
    # "right ahead" is no side.
    assert str(mirrored).replace("left ahead", "right ahead") == swapped.replace("left ahead", "right ahead")


def test_a_reflection_reads_as_english() -> None:
    assert str(Facts((SLOWER, STAY))) == (
        "A standing vehicle is in my lane some 25 metres ahead. "
        "Going on like this would bring me too close, so I should slow down sooner. "
        "My lane is clear. Going on like this would be unnecessary, so I should stay in my lane."
    )
    assert read_facts(NOTHING) == Facts()


@given(facts(), st.data())
def test_no_other_text_is_a_reflection(facts: Facts, data: st.DataObject) -> None:
    text = str(facts)
    place, cut = data.draw(st.integers(0, len(text))), data.draw(st.integers(0, 9))
    changed = (
        text[:place] + data.draw(st.sampled_from(["", " ", "a", ".", "5", "left"])) + text[place + cut :]
    )
    found = facts_of(changed)
    assert found is None or str(found) == changed


@pytest.mark.parametrize(
    "text",
    ["", " ", "I should slow down.", f"{SLOWER}  {STAY}", f"{SLOWER} ", f"{STAY} {SLOWER}", f"{STAY} {STAY}"],
)
def test_free_text_is_refused(text: str) -> None:
    with pytest.raises(PhraseError):
        read_facts(text)


@pytest.mark.parametrize(
    ("cue", "consequence", "correction"),
    [
        (Room("left"), "stuck", "lane_right"),
        (Clear(), "too close", "slower"),
        (Bend("left"), "too fast", "stop"),
        (Thing("vehicle", "my lane", 12), "too close", "slower"),
        (Thing("vehicle", "my lane", 105), "too close", "slower"),
        (Thing("pedestrian", "oncoming", 5), "too close", "slower"),
        (Thing("cone", "my lane", 5, "braking"), "too close", "slower"),
        (Bend("left", 0), "too fast", "slower"),
    ],
)
def test_facts_that_do_not_go_together_are_refused(cue: object, consequence: str, correction: str) -> None:
    with pytest.raises(PhraseError):
        Statement(cue, consequence, correction)  # type: ignore[arg-type]  # what the test is about


def test_a_track_is_named_once_and_in_order() -> None:
    for statements in ((STAY, SLOWER), (SLOWER, SLOWER)):
        with pytest.raises(PhraseError, match="one change of each track"):
            Facts(statements)


@given(plans(), plans(), facts())
def test_the_corrected_plan_changes_as_stated_and_not_otherwise(
    before: Plan, better: Plan, facts: Facts
) -> None:
    after = corrected(before, better, facts)
    stated = {group_of(change): change for change in facts.changes}
    for group in GROUPS:
        assert after.track(group) == (better if group in stated else before).track(group)
    holds = all(change in track_changes(before, better, group) for group, change in stated.items())
    assert agrees(facts, before, after) == holds


def test_a_change_that_is_not_stated_disagrees() -> None:
    before, slower = plan(), plan("Decelerate")
    assert agrees(Facts((SLOWER,)), before, slower)
    assert not agrees(Facts(), before, slower)
    assert agrees(Facts(), before, before)
    assert not agrees(Facts((SLOWER,)), before, before)
    assert not agrees(Facts((SLOWER,)), before, plan("Decelerate", lane="Left Lane Change"))
    assert not agrees(Facts((SLOWER,)), before, plan("Accelerate"))


@pytest.mark.parametrize(
    ("lane", "changes"),
    [
        ("Left Lane Change", {"lane_left"}),
        ("Keep Lane|Left Lane Change", {"lane_left"}),
        ("Left Lane Change|Right Lane Change", {"lane_left"}),
        ("Right Lane Change|Left Lane Change", {"lane_right"}),
        ("Keep Lane", set()),
    ],
)
def test_who_moves_to_one_side_does_not_move_to_the_other_first(lane: str, changes: set[str]) -> None:
    first, _, second = lane.partition("|")
    words = [first] * 32 + [second or first] * 32
    after = Plan(**{**dict(plan().tracks()), "lane": track_from_words(words)})
    assert track_changes(plan(), after, "lane") == changes


@pytest.mark.parametrize(
    ("first", "revised", "changes"),
    [
        ("Keep Speed|Accelerate", "Keep Speed", {"slower"}),
        ("Keep Speed", "Accelerate 1|Decelerate", set()),
        ("Keep Speed", "Accelerate 0.4|Decelerate", {"slower"}),
        ("Decelerate|Keep Speed", "Decelerate 4.1|Accelerate", set()),
        ("Decelerate|Keep Speed", "Decelerate|Accelerate", {"faster"}),
    ],
)
def test_who_slows_down_does_not_speed_up_first(first: str, revised: str, changes: set[str]) -> None:
    def of(text: str) -> Plan:
        one, _, other = text.partition("|")
        word, _, seconds = one.rpartition(" ") if one[-1].isdigit() else (one, "", "3.2")
        ticks = round(10 * float(seconds))
        return Plan(longitudinal=track_from_words([word] * ticks + [other or word] * (64 - ticks)))

    assert track_changes(of(first), of(revised), "longitudinal") == changes


@pytest.mark.parametrize(
    ("first", "revised", "goes_straight"),
    [
        ("5.3 Right Turn|1.1 Straight", "4.7 Right Turn|1.7 Straight", True),
        ("5.3 Right Turn|1.1 Straight", "4.0 Straight|2.4 Right Turn", True),
        ("5.3 Right Turn|1.1 Straight", "6.4 Straight", True),
        ("5.3 Right Turn|1.1 Straight", "5.0 Straight|1.4 Right Turn", False),
        ("5.3 Right Turn|1.1 Straight", "2.0 Straight|3.0 Straight|1.4 Right Turn", False),
        ("5.3 Right Turn|1.1 Straight", "1.0 Straight|1.0 Right Turn|4.0 Straight|0.4 Right Turn", False),
        ("2.8 Straight|3.6 Right Turn", "3.3 Straight|3.1 Right Turn", True),
    ],
)
def test_who_steers_straight_for_longer_turns_in_time_or_not_at_all(
    first: str, revised: str, goes_straight: bool
) -> None:
    def of(text: str) -> Plan:
        parts = [part.split(" ", 1) for part in text.split("|")]
        return Plan(
            lateral=track_from_words([word for took, word in parts for _ in range(round(10 * float(took)))])
        )

    assert ("straight" in track_changes(of(first), of(revised), "lateral")) == goes_straight


def test_who_moves_over_already_is_not_told_to() -> None:
    moves = Plan(lane=track_from_words(["Keep Lane"] * 30 + ["Left Lane Change"] * 34))
    longer = Plan(lane=track_from_words(["Keep Lane"] * 10 + ["Left Lane Change"] * 54))
    assert track_changes(moves, longer, "lane") == set()
    other = Plan(lane=track_from_words(["Right Lane Change"] * 64))
    assert track_changes(moves, other, "lane") == {"lane_right"}


def test_who_stays_in_the_lane_leaves_it_nowhere() -> None:
    leaves = Plan(lane=track_from_words(["Left Lane Change"] * 40 + ["Keep Lane"] * 24))
    later = Plan(lane=track_from_words(["Keep Lane"] * 32 + ["Left Lane Change"] * 32))
    assert track_changes(leaves, later, "lane") == set()
    assert track_changes(leaves, Plan(lane=plan().lane), "lane") == {"keep_lane"}
    assert not agrees(Facts((STAY,)), leaves, later)


@given(plans(), plans())
def test_what_is_needed_for_a_change_is_what_wanted_changes_finds(before: Plan, after: Plan) -> None:
    found = frozenset().union(*wanted_changes(before, after))
    assert found == {change for change in CHANGES if changed(before, after, change)}
