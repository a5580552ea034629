from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from looktwice.model.driving.agents import Agent, SceneError
from looktwice.model.driving.hashing import scene_hash
from looktwice.model.driving.tracks import MAX_TRACKS, Track, nearest_tracks, track_of, tracks_of
from tests.service.scenes import agent, scene

CAR = Track(20.0, 0.0, 0.0, 8.0, 4.5, 1.9, "vehicle", frozenset({"brake", "left"}))


def test_a_track_tells_place_speed_and_lights_of_now() -> None:
    moving = replace(agent(7, "vehicle", (30.0, -3.5), (-6.0, 8.0)), lights=frozenset({"left"}))
    track = track_of(moving)
    assert track is not None
    assert (track.x_m, track.y_m) == pytest.approx((30.0, -3.5))
    assert track.speed_ms == pytest.approx(10.0, rel=1e-3)
    assert track.heading_rad == pytest.approx(math.atan2(8, -6))
    assert track.lights == {"left"}


def test_speed_of_one_who_has_only_just_appeared_comes_from_what_follows() -> None:
    late = agent(1, "vehicle", (30.0, 0.0), (5.0, 0.0))
    late.poses[:15] = np.nan
    track = track_of(late)
    assert track is not None
    assert track.speed_ms == pytest.approx(5.0, rel=1e-3)


def test_the_future_of_one_with_a_past_is_not_looked_at() -> None:
    honest = agent(1, "vehicle", (30.0, 0.0), (5.0, 0.0))
    other = Agent(1, "vehicle", 4.5, 1.9, 1.5, honest.poses.copy())
    other.poses[16:] += 100.0
    assert track_of(other) == track_of(honest)


def test_the_absent_have_no_track() -> None:
    gone = agent(1, "vehicle", (30.0, 0.0), (5.0, 0.0))
    gone.poses[15] = np.nan
    assert track_of(gone) is None
    assert tracks_of([gone]) == ()


def test_the_nearest_are_kept_and_those_ahead_before_those_behind() -> None:
    behind = replace(CAR, x_m=-12.0)
    ahead = replace(CAR, x_m=20.0)
    crowd = [replace(CAR, x_m=40.0 + place) for place in range(MAX_TRACKS)]
    kept = nearest_tracks([*crowd, behind, ahead])
    assert len(kept) == MAX_TRACKS
    assert kept[:2] == (ahead, behind)
    assert crowd[-1] not in kept


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"x_m": math.nan}, "x_m must be finite"),
        ({"speed_ms": 900.0}, "speed_ms must be finite and within"),
        ({"width_m": 0.0}, "width_m must be above 0"),
        ({"kind": "cow"}, "unknown kind 'cow'; known are vehicle"),
        ({"lights": frozenset({"blue"})}, "unknown lights: blue"),
    ],
)
def test_what_is_no_track_is_refused(change: dict[str, object], says: str) -> None:
    with pytest.raises(SceneError, match=says):
        replace(CAR, **change)  # type: ignore[arg-type]  # that is what is tested


def test_a_scene_takes_no_more_than_it_can_hold() -> None:
    with pytest.raises(SceneError, match="at most 16 tracks, got 17: send the nearest"):
        replace(scene(), tracks=(CAR,) * 17)


def test_tracks_change_a_scene_s_hash_and_no_process_changes_it() -> None:
    without, nobody, one = scene(), replace(scene(), tracks=()), replace(scene(), tracks=(CAR,))
    assert len({scene_hash(without), scene_hash(nobody), scene_hash(one)}) == 3
    code = (
        "from dataclasses import replace\n"
        "from looktwice.model.driving.hashing import scene_hash\n"
        "from tests.model.driving.test_tracks import CAR\n"
        "from tests.service.scenes import scene\n"
        "print(scene_hash(replace(scene(), tracks=(CAR,))))"
    )
    told = {
        subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            check=True,
            env={"PYTHONHASHSEED": number, "PYTHONPATH": ":".join(sys.path)},
        ).stdout.strip()
        for number in ("1", "2", "3")
    }
    assert told == {scene_hash(one)}
