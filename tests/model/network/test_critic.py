"""What the critic is given: whom facts and tracks tell of, and how trajectories meet them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from looktwice.model.driving.facts import facts_of
from looktwice.model.driving.outcome import VERDICTS
from looktwice.model.driving.scene import EGO_LENGTH_M
from looktwice.model.driving.tracks import Track
from looktwice.model.driving.trajectory import FloatArray, constant_velocity
from looktwice.model.network.critic import (
    OBJECT_FIELDS,
    Critic,
    objects_of_facts,
    objects_of_tracks,
)
from looktwice.model.network.route_line import RouteLine
from looktwice.model.network.track_features import track_features
from tests.model.driving.test_mends import steady
from tests.model.network.test_route_line import bend

ROUTE = bend(120.0)
HISTORY = steady(10.0)
LEAD = Track(30.0, 3.8, 0.25, 4.0, 4.6, 1.9, "vehicle", frozenset({"brake"}))
WALKER = Track(18.0, -4.0, 1.7, 1.2, 0.6, 0.6, "pedestrian")


def line() -> RouteLine:
    return RouteLine.of(torch.from_numpy(ROUTE)[None], torch.ones(1, dtype=torch.bool))


def told(objects: Tensor, place: int) -> dict[str, float]:
    return dict(zip(OBJECT_FIELDS, objects[0, place].tolist(), strict=True))


def by_facts(*tracks: Track) -> Tensor:
    return objects_of_facts(torch.from_numpy(facts_of(tracks, ROUTE))[None])


def by_tracks(*tracks: Track) -> Tensor:
    return objects_of_tracks(torch.from_numpy(track_features(tracks, ROUTE))[None], line())


@pytest.mark.parametrize("track", [LEAD, WALKER])
def test_facts_and_tracks_tell_of_the_same_object(track: Track) -> None:
    facts, tracks = by_facts(track), by_tracks(track)
    [place] = (facts[0, :, 0] > 0).nonzero()[:, 0].tolist()
    one, other = told(facts, place), told(tracks, 0)
    assert one["walker"] == other["walker"] == float(track.kind == "pedestrian")
    assert one["along_m"] == pytest.approx(other["along_m"], abs=0.4)
    # Facts tell of leads in which lane they are, and of walkers how far aside.
    assert one["left_m"] == pytest.approx(other["left_m"], abs=1.75)
    assert one["speed_along_ms"] + one["speed_left_ms"] == pytest.approx(
        other["speed_along_ms"] + other["speed_left_ms"], abs=0.6
    )
    assert one["braking"] == other["braking"]


def test_nobody_is_nobody() -> None:
    assert by_facts()[..., 0].sum() == 0
    assert by_tracks()[..., 0].sum() == 0


def test_a_verdict_depends_on_whom_a_trajectory_meets_and_on_nobody_who_is_not_there() -> None:
    torch.manual_seed(0)
    critic = Critic().eval()
    poses = torch.from_numpy(np.stack([slow(), constant_velocity(HISTORY)]))[None][..., [0, 1, 3]]
    history = torch.from_numpy(HISTORY)[None]
    with torch.inference_mode():
        alone, met = (critic(poses, history, line(), by_tracks(*tracks)) for tracks in ((), (LEAD,)))
        gone = by_tracks(LEAD)
        gone[..., 0] = 0
        nobody = critic(poses, history, line(), gone)
    assert alone.shape == (1, 2, len(VERDICTS))
    torch.testing.assert_close(nobody, alone)
    assert not torch.allclose(met, alone, atol=1e-3)
    assert not torch.allclose(met[:, 0], met[:, 1], atol=1e-3)


def test_a_trajectory_is_judged_alike_whatever_stands_beside_it() -> None:
    torch.manual_seed(0)
    critic = Critic().eval()
    poses = torch.from_numpy(np.stack([slow(), constant_velocity(HISTORY)]))[None][..., [0, 1, 3]]
    history = torch.from_numpy(HISTORY)[None]
    with torch.inference_mode():
        both = critic(poses, history, line(), by_tracks(LEAD))
        one = critic(poses[:, 1:], history, line(), by_tracks(LEAD))
    torch.testing.assert_close(both[:, 1:], one)


def slow() -> FloatArray:
    trajectory = constant_velocity(HISTORY)
    trajectory[:, 0] *= 0.5
    return trajectory


def test_gaps_are_between_bumpers() -> None:
    """A lead 30 m ahead of the ego's centre: facts tell the gap, and objects where its centre is."""
    track = Track(30.0, 0.0, 0.0, 0.0, 4.6, 1.9, "vehicle")
    straight = bend(1e6)
    facts = torch.from_numpy(facts_of([track], straight))[None]
    assert float(torch.expm1(facts[0, 1])) == pytest.approx(30 - 2.3 - EGO_LENGTH_M / 2, abs=0.01)
    assert told(objects_of_facts(facts), 0)["along_m"] == pytest.approx(30, abs=0.01)
