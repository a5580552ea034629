from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.high_level import HighLevelAction
from looktwice.model.driving.phrases import FARTHEST_M, STEP_M
from looktwice.model.driving.sentences import ThoughtError, decisions, joined
from looktwice.model.driving.thoughts import (
    Crossing,
    Edges,
    Leader,
    Merging,
    Obstacle,
    Road,
    Thoughts,
    read_thoughts,
)
from tests.model.driving.test_high_level import ACTIONS

EDGE = st.one_of(st.none(), st.integers(0, 6).map(lambda step: 0.5 * step))
METRES = st.integers(0, FARTHEST_M // STEP_M).map(lambda step: STEP_M * step)
SIDE = st.sampled_from(["left", "right"])
BESIDE = st.sampled_from(["none", "left", "right", "both"])
THOUGHTS = st.builds(
    Thoughts,
    edges=st.builds(Edges, EDGE, EDGE),
    leader=st.none() | st.builds(Leader, st.sampled_from(["", "standing", "slower", "braking"]), METRES),
    merging=st.none() | st.builds(Merging, SIDE, METRES),
    crossing=st.none()
    | st.builds(
        Crossing,
        st.sampled_from(["vehicle", "pedestrian"]),
        st.sampled_from(["left", "right", "oncoming"]),
        METRES,
        st.booleans(),
    ),
    road=st.builds(Road, beside=BESIDE) | st.builds(Road, SIDE, METRES, BESIDE),
    obstacle=st.none() | st.builds(Obstacle, st.sampled_from(["cone", "barrier", "pedestrian"]), METRES),
    action=ACTIONS,
)
SOME = Thoughts(
    edges=Edges(None, 1.5),
    leader=Leader("slower", 20),
    merging=Merging("left", 0),
    crossing=Crossing("pedestrian", "right", 15, first=True),
    road=Road("left", 25, "right"),
    obstacle=Obstacle("cone", 40),
    action=HighLevelAction("decelerate", "change right"),
)


def test_it_is_told_in_the_order_of_the_prompt() -> None:
    assert str(SOME) == (
        "Road edges: left far, right 1.5 m. "
        "In my lane: a slower vehicle 20 m ahead. "
        "Merging: from the left beside me. "
        "Crossing: a pedestrian from the right 15 m ahead, before me. "
        "Road: bends left 25 m ahead, a lane on the right, a cone in the way 40 m ahead. "
        "Next: decelerate and change to the right lane."
    )
    nobody = replace(SOME, leader=None, merging=None, crossing=None, road=Road(), obstacle=None)
    assert "In my lane: nobody. Merging: nobody. Crossing: nobody. Road: straight, no lane" in str(nobody)


@given(THOUGHTS)
def test_every_chain_of_thought_reads_back(thoughts: Thoughts) -> None:
    assert read_thoughts(str(thoughts)) == thoughts
    assert joined(decisions(str(thoughts))) == str(thoughts)


@given(THOUGHTS)
def test_mirrored_twice_is_the_same(thoughts: Thoughts) -> None:
    assert thoughts.mirrored().mirrored() == thoughts
    # "Right ahead" tells no side.
    text, other = (str(each).replace("right ahead", "") for each in (thoughts, thoughts.mirrored()))
    assert (text.count("left"), text.count("right")) == (other.count("right"), other.count("left"))


@given(THOUGHTS, st.data())
def test_what_is_no_chain_of_thought_is_refused(thoughts: Thoughts, data: st.DataObject) -> None:
    text = str(thoughts)
    place = data.draw(st.integers(0, len(text) - 1))
    for other in (text[:place], text + text[place:], text[:place] + "~" + text[place + 1 :]):
        with pytest.raises(ThoughtError):
            read_thoughts(other)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"edges": Edges(0.3, None)}, "no words for 0.3"),
        ({"leader": Leader("slower", 7)}, "no words for 7"),
        ({"road": Road("left", None)}, "no words for None"),
        ({"road": Road(None, 5)}, "no words for 5"),
    ],
)
def test_what_there_are_no_words_for_cannot_be_stated(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ThoughtError, match=message):
        replace(SOME, **changes)  # type: ignore[arg-type]  # fields are told as a table


def test_an_error_says_where_and_what_was_expected() -> None:
    with pytest.raises(ThoughtError, match=r"character 49: expected one of ' nobody', .*, found ' a lorry"):
        read_thoughts(str(SOME).replace("slower vehicle", "lorry").replace("far", "0.0 m"))
