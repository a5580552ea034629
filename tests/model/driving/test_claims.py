from __future__ import annotations

import asyncio

import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.clients.labelling.teachers.rules import RuleTeacher
from looktwice.clients.labelling.teachers.teacher import NothingInView, Question
from looktwice.model.bundled import SCENES
from looktwice.model.driving.claims import claims, unfounded
from looktwice.model.driving.direction import wanted_changes
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.phrases import read_facts
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.seen import all_shown
from looktwice.model.driving.view import Sight, Surroundings, View, view_of

VAN = Sight("vehicle", 30.0, "my lane", 5.0)
WALKER = Sight("pedestrian", 12.0, "the right side", 0.0)
BUSY = View(10.0, (WALKER, VAN), "left", 20.0, frozenset({"right"}), frozenset({"left"}))
EMPTY = View(10.0, (), None, 0.0)


@pytest.mark.parametrize(
    "text",
    [
        "A van stands in my lane, some 30 metres ahead.",
        "A car is ahead, about 33 m away, and a pedestrian walks on the right.",
        "A person on foot is on the right side, 12 meters ahead, so I should brake.",
        "There is room in the left lane, so I should move over.",
        "The lane to the left of mine is open.",
        "The road bends left some 20 metres ahead.",
        "A curve begins some 25 metres ahead.",
        "The junction lets me turn right here.",
        "No cones are in my lane.",
        # What is feared or asked for is no claim.
        "A van is in my lane. Accelerating would bring me too close to the barrier.",
        "A van is in my lane, so I should look out for cones in the right lane.",
    ],
)
def test_what_is_in_view_is_found_there(text: str) -> None:
    assert claims(text)
    assert unfounded(text, BUSY) == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("A van stands in the left lane.", "van stands in the left lane."),
        ("A van stands in my lane, some 60 metres ahead.", "van stands in my lane, some 60 metres ahead."),
        ("A cone is in my lane, so I should brake.", "cone is in my lane"),
        ("A pedestrian is on the left side.", "pedestrian is on the left side."),
        ("My lane is clear as far as I can see.", "my lane is clear as far as i can see."),
        ("There is room in the right lane.", "there is room in the right lane."),
        ("The road bends right some 20 metres ahead, so I should slow down.", None),
        ("A curve begins right ahead.", None),
        ("The lane markings run straight ahead.", None),
        ("The lane leads left off this road.", None),
        ("No vehicles are in my lane.", None),
    ],
)
def test_what_is_not_in_view_is_told(text: str, words: str | None) -> None:
    found = unfounded(text, BUSY)
    assert len(found) == 1
    assert words is None or found[0].words == words


def test_an_empty_road_is_clear() -> None:
    assert unfounded("The road ahead in my lane is free. The lane runs straight on here.", EMPTY) == []
    assert unfounded("There is nothing in my lane.", BUSY)


@pytest.mark.parametrize("text", ["", "I should slow down.", "Going on as planned would miss the way."])
def test_a_text_that_names_nothing_claims_nothing(text: str) -> None:
    assert claims(text) == []


@given(st.text() | st.from_regex(r"(?:(?:A|no) (?:car|cone) [a-z ,]{0,20}[.;] ?){0,4}", fullmatch=True))
def test_any_text_can_be_read(text: str) -> None:
    missing = [claim.words for claim in unfounded(text, EMPTY)]
    assert missing == [claim.words for claim in claims(text) if not claim.holds(EMPTY)]


def test_the_built_in_teacher_claims_nothing_that_is_not_in_view() -> None:
    scenes = list(read_scenes(SCENES, dense=False))
    plans = [expert_plan(labelled) for labelled in scenes]
    checked = 0
    for number, labelled in enumerate(scenes):
        view = view_of(labelled.scene, Surroundings.of(labelled))
        for seed, predicted in enumerate(plans):
            question = Question(labelled.scene, predicted, plans[number], Surroundings.of(labelled), seed)
            try:
                answer = asyncio.run(RuleTeacher().reflect(question))
            except NothingInView:
                continue
            assert unfounded(answer.text, view) == [], answer.text
            shown = all_shown(read_facts(answer.text), view)
            assert shown or (shown is None and not wanted_changes(predicted, plans[number]))
            checked += 1
    assert checked > 100
