from __future__ import annotations

from dataclasses import replace

import pytest

from clients.labelling.teachers.preference import remedies_first
from model.driving.direction import Change
from model.driving.outcome import FailureName, Outcome, in_words

HOLDS = Outcome((), None, None, None, None, None, None, 60.0, 60.0)


@pytest.mark.parametrize(
    ("fails", "first"),
    [
        (("collision",), "slower"),
        (("behind",), "lane_left"),
        (("off_road", "off_route"), "left"),
        (("comfort", "off_road"), "slower"),
        (("ahead",), "slower"),
        ((), "lane_left"),
    ],
)
def test_what_helps_comes_first(fails: tuple[FailureName, ...], first: Change) -> None:
    changes: list[frozenset[Change]] = [frozenset({"lane_left"}), frozenset({"slower"}), frozenset({"left"})]
    ordered = remedies_first(changes, replace(HOLDS, fails=fails))
    assert ordered[0] == {first}
    assert sorted(map(sorted, ordered)) == sorted(map(sorted, changes))
    assert remedies_first(changes, None) == changes


@pytest.mark.parametrize(
    ("outcome", "words"),
    [
        (HOLDS, ""),
        (
            replace(HOLDS, fails=("collision",), collided_s=2.1, hit="standing vehicle"),
            "collides with a standing vehicle after 2.1 s",
        ),
        (
            replace(HOLDS, fails=("collision",), collided_s=3.0, hit="oncoming vehicle"),
            "collides with an oncoming vehicle after 3.0 s",
        ),
        (
            replace(HOLDS, fails=("off_road", "off_route"), off_road_s=1.0, off_route_s=0.5),
            "leaves the road after 1.0 s, leaves the lanes of its route after 0.5 s",
        ),
        (
            replace(HOLDS, fails=("comfort",), uncomfortable_s=0.4, uncomfortable="longitudinal_jerk"),
            "has too much longitudinal jerk after 0.4 s",
        ),
        (replace(HOLDS, fails=("behind",), driven_m=42.0), "falls behind by 18 m"),
        (replace(HOLDS, fails=("ahead",), driven_m=78.0), "goes 18 m too far"),
    ],
)
def test_failures_in_words(outcome: Outcome, words: str) -> None:
    assert in_words(outcome) == words
