from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from looktwice.model.driving.cameras import CAMERA_SPECS
from looktwice.model.evaluation.entering import Entering, entering, shows
from looktwice.model.network.visual_codes import Frame
from tests.model.driving.drives import agent, labelled_scene

OVERTAKING = agent(-2.0, 3.5, speed=20.0, agent_id=7)
"""It comes from beside to 8 m ahead in half a second."""


def grey(level: int) -> Frame:
    return np.full((112, 224, 3), level, np.uint8)


def test_who_overtakes_enters_the_front_view() -> None:
    labelled = labelled_scene(0.0, agents=(OVERTAKING, agent(20.0, 0.0, agent_id=8)))
    [who] = entering(labelled, "front")
    assert who.agent_id == 7
    [[column, row, _]] = CAMERA_SPECS["front"].project(np.array([[8.0, 3.5, 0.75]]))
    assert who.left < column < who.right
    assert who.top < row < who.bottom
    # As far as the picture reaches.
    assert 0 <= who.left < who.right <= 224
    assert 0 <= who.top < who.bottom <= 112
    # It was beside before, so that camera loses it.
    assert entering(labelled, "back_left") == []


def test_views_move_with_the_ego() -> None:
    """A walker who stands ahead comes into the view of 20 to 90 degrees to the left."""
    walker = agent(16.0, 4.0, kind="pedestrian", size_m=(1.2, 1.2, 1.8))
    assert entering(labelled_scene(0.0, agents=(walker,)), "front_left") == []
    [who] = entering(labelled_scene(16.0, agents=(walker,)), "front_left")
    # Eight metres on it stands at 26 degrees, so near the right edge.
    assert 170 < who.left < who.right < 224


def test_who_is_not_there_or_is_a_speck_does_not_enter() -> None:
    poses = OVERTAKING.poses.copy()
    poses[:16] = np.nan
    absent = replace(OVERTAKING, poses=poses)
    far = agent(-40.0, 60.0, speed=200.0)
    for nobody in (absent, far):
        assert entering(labelled_scene(0.0, agents=(nobody,)), "front") == []


@pytest.mark.parametrize(("level", "shown"), [(200, True), (160, True), (140, False), (100, False)])
def test_a_picture_shows_what_comes_or_what_was(level: int, shown: bool) -> None:
    who = Entering("front", 7, 10, 50, 40, 90)
    assert shows(who, grey(level), came=grey(200), moved=grey(100)) is shown


def test_only_the_box_counts_and_what_changes_nothing_is_not_told() -> None:
    who = Entering("front", 7, 10, 50, 40, 90)
    picture, came = grey(100), grey(100)
    came[50:90, 10:40] = 200
    assert shows(who, picture, came, moved=grey(100)) is False
    picture[50:90, 10:40] = 200
    assert shows(who, picture, came, moved=grey(100)) is True
    assert shows(who, picture, came, moved=came) is None
