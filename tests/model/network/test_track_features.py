from __future__ import annotations

from dataclasses import replace

import numpy as np

from looktwice.model.driving.tracks import Track
from looktwice.model.network.track_features import MIRRORED, TRACK_FEATURES, track_features

ROUTE = np.stack([4.0 * np.arange(1, 21), 0.02 * (4.0 * np.arange(1, 21)) ** 1.5], axis=1).astype(np.float32)
CAR = Track(20.0, 3.0, 0.2, 8.0, 4.5, 1.9, "vehicle", frozenset({"left"}))


def test_nobody_is_all_zeros_and_somebody_is_not() -> None:
    assert not track_features((), ROUTE).any()
    features = track_features((CAR,), ROUTE)
    assert features[0].any()
    assert not features[1:].any()


def test_a_mirrored_scene_has_mirrored_features() -> None:
    mirrored_car = replace(CAR, y_m=-CAR.y_m, heading_rad=-CAR.heading_rad, lights=frozenset({"right"}))
    expected = track_features((CAR,), ROUTE)
    expected[:, list(MIRRORED)] *= -1
    found = track_features((mirrored_car,), (ROUTE * [1, -1]).astype(np.float32))
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_without_a_route_what_is_relative_to_it_is_zero() -> None:
    features = dict(zip(TRACK_FEATURES, track_features((CAR,), None)[0], strict=True))
    assert not any(features[name] for name in ("on_route", "along", "left", "speed_along", "speed_left"))
    assert features["speed"] > 0


def test_hazard_lights_are_no_indicator() -> None:
    both = replace(CAR, lights=frozenset({"left", "right"}))
    features = dict(zip(TRACK_FEATURES, track_features((both,), ROUTE)[0], strict=True))
    assert (features["hazard"], features["indicator"]) == (1.0, 0.0)
