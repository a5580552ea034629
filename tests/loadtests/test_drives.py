from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from looktwice.loadtests.bodies import drive, make_drives
from looktwice.loadtests.mix import Mix
from tests.loadtests.scenes import labelled_scenes

SCENE = labelled_scenes()[0].scene


def test_clips_slide_on_every_half_second() -> None:
    seen = drive(SCENE, 7, hz=10, seconds=2)
    assert len(seen) == 20
    for before, after in pairwise(seen):
        old, new = before.clips[0].images, after.clips[0].images
        assert new in (old, (*old[1:], new[3]))
    slides = [after.clips != before.clips for before, after in pairwise(seen)]
    assert [place + 1 for place, slid in enumerate(slides) if slid] == [5, 10, 15]


def test_histories_move_on_at_every_tick() -> None:
    seen = drive(SCENE, 7, hz=10, seconds=1)
    assert all(not np.array_equal(a.history, b.history) for a, b in pairwise(seen[5:]))
    np.testing.assert_allclose(drive(SCENE, 7, hz=5, seconds=1)[2].history, seen[4].history, atol=1e-4)


def test_no_two_planners_share_a_picture() -> None:
    one, other = (
        {image for scene in drive(SCENE, number, 10, 1) for clip in scene.clips for image in clip.images}
        for number in (1_000_003, 2_000_006)
    )
    assert not one & other


def test_every_planner_has_its_own_drive_and_one_kind_of_request() -> None:
    drives = make_drives(labelled_scenes(), Mix(works={"direct": 1, "think": 1}), 4, 10, 0.5, seed=2)
    assert [len(calls) for calls in drives] == [5] * 4
    assert all(len({call.kind for call in calls}) == 1 for calls in drives)


@pytest.mark.parametrize("hz", [20, 3, 0.3])
def test_rates_that_histories_cannot_follow_are_refused(hz: float) -> None:
    with pytest.raises(ValueError, match="10, 5, 2 or 1"):
        drive(SCENE, 7, hz, 1)
