"""Cues that may be named, against what annotations show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.driving.cues import cues_in, cues_read, cues_tracked
from model.driving.facts import FACTS, facts_of
from model.driving.phrases import STEP_M, Bend, Clear, Cue, Straight, Thing, sentence
from model.driving.seen import shown
from model.driving.tracks import Track
from model.driving.trajectory import FloatArray
from model.driving.view import Sight, View, view_along

PLACES = ("my lane", "the left lane", "the right lane", "the left side", "the right side")
SIGHTS = st.builds(
    Sight,
    st.sampled_from(("vehicle", "pedestrian", "cone", "barrier")),
    st.floats(0, 120),
    st.sampled_from(PLACES),
    st.floats(-20, 30) | st.just(float("nan")),
    st.booleans(),
)
SIDES = st.frozensets(st.sampled_from(("left", "right")))
VIEWS = st.builds(
    View,
    st.floats(0, 30),
    st.lists(SIGHTS, max_size=6).map(lambda sights: tuple(sorted(sights, key=lambda each: each.ahead_m))),
    st.sampled_from(("left", "right", None)),
    st.floats(0, 45),
    SIDES,
    SIDES,
)
AHEAD = Track(30.0, 0.0, 0.0, 4.0, 4.5, 1.9, "vehicle", frozenset({"brake"}))


def history(speed_ms: float) -> FloatArray:
    poses = np.zeros((16, 4), np.float32)
    poses[:, 0] = speed_ms * 0.1 * np.arange(-15, 1)
    return poses


def straight_on() -> FloatArray:
    return np.stack([4.0 * np.arange(1, 21), np.zeros(20)], axis=1).astype(np.float32)


def read(*tracks: Track) -> FloatArray:
    """The facts of tracks, as a network would tell them that reads them without error."""
    return np.nan_to_num(facts_of(tracks, straight_on()))


@given(VIEWS)
def test_whatever_may_be_said_of_a_view_is_in_view(view: View) -> None:
    cues = cues_in(view)
    assert all(shown(cue, view) for cue in cues)
    assert len({sentence(cue) for cue in cues}) == len(cues)
    named = {(cue.kind, cue.ahead_m) for cue in cues if isinstance(cue, Thing)}
    told = [(sight, STEP_M * round(sight.ahead_m / STEP_M)) for sight in view.sights]
    assert named == {
        (sight.kind, ahead_m)
        for sight, ahead_m in told
        if ahead_m <= (100 if sight.place == "my lane" else 45)
    }


def test_tracks_tell_who_is_where_and_what_they_do() -> None:
    cues = cues_tracked(
        history(10.0), straight_on(), (AHEAD, replace(AHEAD, x_m=45.0, y_m=3.5, lights=frozenset()))
    )
    assert Thing("vehicle", "my lane", 25, "braking") in cues
    assert Thing("vehicle", "my lane", 25) in cues
    assert Thing("vehicle", "the left lane", 40, "slower") in cues
    assert Straight() in cues
    assert Clear() not in cues


def test_what_no_camera_shows_is_not_named() -> None:
    behind, hidden = replace(AHEAD, x_m=-20.0), replace(AHEAD, x_m=50.0)
    assert cues_tracked(history(10.0), straight_on(), (behind,)) == {Straight(), Clear()}
    assert {
        cue.ahead_m for cue in cues_tracked(history(10.0), None, (AHEAD, hidden)) if isinstance(cue, Thing)
    } == {25}


def test_a_way_that_bends_is_a_bend() -> None:
    angles = np.linspace(0, 1.2, 20)
    way = (4 * np.stack([np.cos(angles), np.sin(angles)], axis=1)).cumsum(axis=0).astype(np.float32)
    cues = cues_tracked(history(10.0), way, ())
    assert Bend("left") in cues
    assert Straight() not in cues
    bending = read()
    bending[FACTS.index("road_left_8m") : FACTS.index("road_left_80m") + 1] = way[1::2, 1] / 10
    assert Bend("left") in cues_read(history(10.0), None, bending)
    assert Straight() in cues_read(history(10.0), straight_on(), bending)


def test_facts_that_are_read_without_error_tell_the_lead_as_its_track_does() -> None:
    told = cues_tracked(history(10.0), straight_on(), (AHEAD,))
    assert cues_read(history(10.0), straight_on(), read(AHEAD)) == told


@pytest.mark.parametrize(("present", "expected"), [(0.2, {Straight(), Clear()}), (0.5, {Straight()})])
def test_what_is_read_in_doubt_is_neither_there_nor_absent(present: float, expected: set[Cue]) -> None:
    facts = read(AHEAD)
    facts[FACTS.index("own_0_present")] = present
    assert cues_read(history(10.0), straight_on(), facts) == expected


@given(st.lists(st.floats(-6, 6), min_size=len(FACTS), max_size=len(FACTS)))
def test_any_reading_gives_cues_that_can_be_said(values: list[float]) -> None:
    for cue in cues_read(history(10.0), None, np.array(values, np.float32)):
        assert sentence(cue)


def test_a_view_along_the_way_knows_no_other_lanes() -> None:
    view = view_along(history(10.0), straight_on(), (AHEAD,))
    assert (view.turns, view.beside) == (frozenset(), frozenset())
