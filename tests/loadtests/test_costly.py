"""What makes a run of `costly` count, on figures that are made up; and what it sends."""

from __future__ import annotations

import base64
import json
from typing import Any

import pytest

from looktwice.loadtests.attacks import costly_calls, never_seen
from looktwice.loadtests.bodies import make_call
from looktwice.loadtests.mix import RequestKind
from looktwice.loadtests.scenarios.hostile import missed_goals
from looktwice.model.driving.images import decode_image
from tests.model.driving.drives import labelled_scene

MET: dict[str, Any] = {
    "polite_p95_ratio": 1.5,
    "peak_bytes": 1_500_000_000,
    "stop_s": 25.0,
    "drain_s": 25.0,
    "exit_code": 0,
}


def test_goals_that_are_just_met_are_met() -> None:
    assert missed_goals(MET) == []


def test_what_was_not_measured_is_not_asked_for() -> None:
    assert missed_goals({"polite_p95_ratio": 1.0}) == []


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"polite_p95_ratio": 1.51}, "polite p95 was 1.51 times"),
        ({"polite_p95_ratio": None}, "no p95"),
        ({"peak_bytes": 1_501_000_000}, "memory was 1501 MB"),
        ({"stop_s": 25.1}, "25.1 s to stop"),
        ({"drain_s": 5.0}, "it drains for 5 s"),
        ({"exit_code": -9}, "with -9"),
    ],
)
def test_a_goal_that_is_missed_is_told(change: dict[str, Any], told: str) -> None:
    [missed] = missed_goals(MET | change)
    assert told in missed


def test_pictures_of_dear_requests_were_never_seen_before() -> None:
    polite = make_call(RequestKind("direct", 1), [labelled_scene(8.0, pictures=1)], seed=1)
    large = costly_calls(polite)[2]
    bodies = [json.loads(never_seen(large.body)) for _ in range(2)]
    pictures = [
        base64.b64decode(image)
        for body in bodies
        for clip in body["scene"]["clips"]
        for image in clip["images"]
    ]
    assert len(set(pictures)) == len(pictures) > 2
    assert len({decode_image(picture).tobytes() for picture in pictures[:3]}) == 1
