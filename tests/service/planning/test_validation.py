from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from looktwice.clients import wire
from looktwice.service.planning.validation import MAX_STEP_CHANGE_M, engine_request, geometry_of
from looktwice.service.problems import INVALID_ATTEMPT, INVALID_TRACKS, ProblemError
from tests.service.scripted_engine import CARD
from tests.service.serving import body


def with_history(rows: np.ndarray) -> wire.PlanRequest:
    document = body()
    document["scene"]["history"] = rows.tolist()
    return wire.PlanRequest.model_validate(document)


def driven(speeds_mps: np.ndarray) -> np.ndarray:
    """Straight on with these 15 speeds, ending at the present."""
    rows = np.zeros((16, 4))
    rows[:-1, 0] = -np.cumsum(0.1 * speeds_mps[::-1])[::-1]
    return rows


@pytest.mark.parametrize(
    "speeds",
    [
        np.zeros(15),
        np.full(15, 40.0),
        np.linspace(13, 0, 15),  # an emergency stop, 9 m/s²
        np.full(15, -2.0),
    ],
    ids=["standing", "fast", "emergency stop", "reverse"],
)
def test_what_cars_do_is_accepted(speeds: np.ndarray) -> None:
    engine_request(with_history(driven(speeds)), CARD, "id")


def test_measured_poses_may_be_noisy() -> None:
    rows = driven(np.full(15, 20.0))
    rows[:-1, :2] += np.random.default_rng(0).normal(0, 0.1, (15, 2)).clip(-0.2, 0.2)
    engine_request(with_history(rows), CARD, "id")


def test_a_heading_may_wrap_around() -> None:
    rows = driven(np.full(15, 1.0))
    rows[:-1, 3] = 0.05 * np.arange(15, 0, -1)
    rows[:8, 3] -= 2 * np.pi
    engine_request(with_history(rows), CARD, "id")


@pytest.mark.parametrize("row", range(1, 14))
def test_any_two_rows_out_of_order_are_found(row: int) -> None:
    rows = driven(np.full(15, 8.0))
    rows[[row, row + 1]] = rows[[row + 1, row]]
    with pytest.raises(ProblemError, match="in order of time") as caught:
        engine_request(with_history(rows), CARD, "id")
    assert f"{3 * 0.8:.1f} m" in caught.value.detail
    assert MAX_STEP_CHANGE_M < 3 * 0.8


def test_geometry_that_is_checked_is_not_checked_again() -> None:
    geometry = geometry_of(with_history(driven(np.full(15, 8.0))).scene)
    unchecked = with_history(driven(np.full(15, 400.0)))
    scene = engine_request(unchecked, CARD, "id", geometry).scene
    np.testing.assert_array_equal(scene.history, geometry.history)
    with pytest.raises(ProblemError, match="is it 10 Hz and metres"):
        engine_request(unchecked, CARD, "id")


def test_cameras_the_model_does_not_need_are_welcome() -> None:
    document = body()
    document["scene"]["clips"].append(document["scene"]["clips"][0] | {"camera": "back"})
    request = engine_request(wire.PlanRequest.model_validate(document), CARD, "id")
    assert [clip.camera for clip in request.scene.clips] == ["front_wide_120", "front_tele_30", "back"]


REFINING = replace(CARD, formats=("elf_vla", "elf_vla_refine"))
HALF_SECONDS = [0.5 * step for step in range(1, 9)]
DRAFT = {"trajectory": [[4.0 * step, 0.0, 0.0, 0.0] for step in range(1, 9)], "times_s": HALF_SECONDS}


def with_attempt(format: str, **attempt: Any) -> wire.PlanRequest:
    document = body() | {"format": format}
    return wire.PlanRequest.model_validate(document | ({"attempt": attempt} if attempt else {}))


def test_an_attempt_reaches_a_format_that_refines_it() -> None:
    asked = with_attempt("elf_vla_refine", **DRAFT, feedback="Wait.")
    attempt = engine_request(asked, REFINING, "id").attempt
    assert attempt is not None
    assert (attempt.trajectory.tolist(), attempt.feedback) == (DRAFT["trajectory"], "Wait.")


@pytest.mark.parametrize(
    ("format", "attempt", "pointer", "message"),
    [
        ("elf_vla", DRAFT | {"feedback": "Wait."}, "/attempt", "elf_vla refines none"),
        ("elf_vla_refine", {}, "/attempt", "elf_vla_refine refines an attempt, and there is none"),
        (
            "elf_vla_refine",
            {"trajectory": [[0.0] * 4] * 64, "feedback": "Wait."},
            "/attempt/times_s",
            "poses at 0.5, 1, 1.5, 2, 2.5, 3, 3.5, 4 s",
        ),
        (
            "elf_vla_refine",
            DRAFT | {"trajectory": [[1001.0, 0.0, 0.0, 0.0]] * 8, "feedback": "Wait."},
            "/attempt/trajectory",
            "beyond ±1000",
        ),
    ],
)
def test_attempts_are_refused_where_they_do_not_belong(
    format: str, attempt: dict[str, Any], pointer: str, message: str
) -> None:
    with pytest.raises(ProblemError, match=message) as caught:
        engine_request(with_attempt(format, **attempt), REFINING, "id")
    assert caught.value.kind is INVALID_ATTEMPT
    assert caught.value.errors[0].pointer == pointer


CAR = {
    **{"x_m": 20.0, "y_m": 0.0, "heading_rad": 0.0, "speed_ms": 3.0, "length_m": 4.5, "width_m": 1.9},
    **{"kind": "vehicle", "lights": ["brake"]},
}


def with_tracks(*tracks: dict[str, object]) -> wire.PlanRequest:
    document = body()
    document["scene"]["tracks"] = list(tracks)
    return wire.PlanRequest.model_validate(document)


def test_tracks_reach_a_model_that_takes_them() -> None:
    card = replace(CARD, inputs=("route", "tracks"))
    [track] = engine_request(with_tracks(CAR), card, "id").scene.tracks or ()
    assert (track.x_m, track.speed_ms, track.kind) == (20.0, 3.0, "vehicle")
    assert track.lights == frozenset({"brake"})
    assert engine_request(with_tracks(), card, "id").scene.tracks == ()  # nobody is around
    assert engine_request(with_history(driven(np.zeros(15))), card, "id").scene.tracks is None


def test_tracks_that_cannot_be_are_refused_by_place() -> None:
    card = replace(CARD, inputs=("route", "tracks"))
    with pytest.raises(ProblemError, match="heading_rad") as caught:
        engine_request(with_tracks(CAR, CAR | {"heading_rad": 90.0}), card, "id")
    assert caught.value.kind is INVALID_TRACKS
    assert caught.value.errors[0].pointer == "/scene/tracks/1"


def test_a_model_without_tracks_says_so() -> None:
    with pytest.raises(ProblemError, match="takes none"):
        engine_request(with_tracks(CAR), CARD, "id")
