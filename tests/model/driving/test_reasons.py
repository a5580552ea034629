"""Reasons that a view gives, against what annotations show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.facts import FACTS, facts_of
from looktwice.model.driving.phrases import Bend, Clear, Statement, Straight, Thing
from looktwice.model.driving.reasons import reasons_in, reasons_read, reasons_tracked
from looktwice.model.driving.seen import shown
from looktwice.model.driving.tracks import Track
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.driving.view import Sight, View, view_along

PLACES = ("my lane", "the left lane", "the right lane", "the left side", "the right side")
SIGHTS = st.builds(
    Sight,
    st.sampled_from(("vehicle", "pedestrian", "cone", "barrier")),
    st.floats(0, 100),
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
LEAD = Thing("vehicle", "my lane", 25, "braking")
FASTER = Statement(Clear(), "too cautious", "faster")
STAYS = Statement(Clear(), "unnecessary", "keep_lane")
STRAIGHT = Statement(Straight(), "out of lane", "straight")


def history(speed_ms: float = 10.0) -> FloatArray:
    poses = np.zeros((16, 4), np.float32)
    poses[:, 0] = speed_ms * 0.1 * np.arange(-15, 1)
    return poses


def straight_on() -> FloatArray:
    return np.stack([4.0 * np.arange(1, 21), np.zeros(20)], axis=1).astype(np.float32)


def read(*tracks: Track) -> FloatArray:
    """The facts of tracks, as a network would tell them that reads them without error."""
    return np.nan_to_num(facts_of(tracks, straight_on()))


@given(VIEWS)
def test_every_reason_is_in_view(view: View) -> None:
    assert all(shown(each.cue, view) for each in reasons_in(view))


def test_one_slows_down_for_a_lead_and_may_leave_its_lane() -> None:
    assert reasons_tracked(history(), straight_on(), (AHEAD,)) == {
        STRAIGHT,
        *(Statement(LEAD, "too close", change) for change in ("slower", "stop")),
        *(Statement(LEAD, "stuck", change) for change in ("lane_left", "lane_right")),
    }


def test_what_no_camera_shows_is_no_reason() -> None:
    behind, hidden = replace(AHEAD, x_m=-20.0), replace(AHEAD, x_m=50.0)
    assert reasons_tracked(history(), straight_on(), (behind,)) == {STRAIGHT, FASTER, STAYS}
    assert reasons_tracked(history(), None, (AHEAD, hidden)) == reasons_tracked(history(), None, (AHEAD,))


def test_a_way_that_bends_is_a_bend() -> None:
    angles = np.linspace(0, 1.2, 20)
    way = (4 * np.stack([np.cos(angles), np.sin(angles)], axis=1)).cumsum(axis=0).astype(np.float32)
    bend = Statement(Bend("left", 10), "out of lane", "left")
    assert bend in reasons_tracked(history(), way, ())
    assert STRAIGHT not in reasons_tracked(history(), way, ())
    bending = read()
    bending[FACTS.index("road_left_8m") : FACTS.index("road_left_80m") + 1] = way[1::2, 1] / 10
    assert {each.change for each in reasons_read(history(), None, bending)} >= {"left", "slower"}
    assert STRAIGHT in reasons_read(history(), straight_on(), bending)


def test_facts_that_are_read_without_error_tell_the_lead_as_its_track_does() -> None:
    told = reasons_tracked(history(), straight_on(), (AHEAD,))
    assert reasons_read(history(), straight_on(), read(AHEAD)) == told


@pytest.mark.parametrize(("present", "expected"), [(0.2, {STRAIGHT, FASTER, STAYS}), (0.5, {STRAIGHT})])
def test_who_may_be_there_is_no_reason_but_nothing_is_clear(present: float, expected: set[Statement]) -> None:
    facts = read(AHEAD)
    facts[FACTS.index("own_0_present")] = present
    assert reasons_read(history(), straight_on(), facts) == expected


@given(st.lists(st.floats(-6, 6), min_size=len(FACTS), max_size=len(FACTS)))
def test_any_reading_gives_reasons_that_can_be_stated(values: list[float]) -> None:
    for each in reasons_read(history(), None, np.array(values, np.float32)):
        assert str(each)


def test_a_view_along_the_way_knows_no_other_lanes() -> None:
    view = view_along(history(), straight_on(), (AHEAD,))
    assert (view.turns, view.beside) == (frozenset(), frozenset())
