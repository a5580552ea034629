from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.driving.scene import CAMERAS
from model.driving.trajectory import constant_turn_rate
from model.families.vla_world.format import (
    CAMERA_OPTIONS,
    TIMES_S,
    VISUAL_ALPHABET,
    VISUAL_CODES,
    VISUAL_SIZE,
    VLA_WORLD_FORMAT,
    read_points,
    read_trajectory,
    told_points,
)
from model.formats.cursor import CompiledFormat
from model.formats.pieces import FormatError, Values
from model.formats.text import parse
from model.network.visual_codes import CODEBOOK_SIZE, CODES
from tests.model.driving.drives import drive
from tests.model.formats.strategies import values_of
from tests.model.formats.vocabulary import ByteVocabulary


class ImaginingVocabulary(ByteVocabulary):
    """With an alphabet of codes of pictures."""

    def __init__(self, size: int = VISUAL_SIZE) -> None:
        super().__init__()
        first = len(self.texts)
        self.texts += [f"<|v_{code}|>" for code in range(size)]
        self.alphabets[VISUAL_ALPHABET] = (range(first, first + size),)
        self._ids |= {text: first + code for code, text in enumerate(self.texts[first:])}

    def encode(self, text: str) -> tuple[int, ...]:
        # Codes are only ever written one by one.
        return (self._ids[text],) if text.startswith("<|v_") else super().encode(text)


VOCABULARY = ImaginingVocabulary()


@cache
def compiled() -> CompiledFormat:
    return CompiledFormat(VLA_WORLD_FORMAT, VOCABULARY)


POINT = {"lateral_m": -0.1, "forward_m": 0.5}
SAMPLE = Values(
    {
        "perception": (
            (
                {
                    "kind": "pedestrian",
                    "object_id": 1.0,
                    "lateral_m": -4.5,
                    "forward_m": 3.2,
                    "width_m": 0.7,
                    "length_m": 0.7,
                },
            ),
            1.5,
            14.0,
        ),
        "prediction": (POINT, "Left"),
        "visual": (tuple(range(VISUAL_CODES)), "CAM_FRONT_LEFT"),
        "think": (({"kind": "pedestrian", "lateral_m": -4.5, "forward_m": 3.2, "time_s": 2.0},),),
        "action": ({"lateral": "TURN LEFT", "speed": "A QUICK ACCELERATION"},),
        "answer": ((POINT,) * 6,),
    }
)


def written(values: Values) -> str:
    return VOCABULARY.decode([token.id for token in compiled().render(values)])


def test_the_papers_sample() -> None:
    """Figure 5b, rounded to 0.1 m."""
    codes = "".join(f"<|v_{code}|>" for code in range(VISUAL_CODES))
    points = ", ".join(["(-0.1,0.5)"] * 6)
    assert written(SAMPLE) == (
        "<perception>Object detections: object type: pedestrian, object id: 1, position: (-4.5, 3.2), "
        "size: (0.7, 0.7). Distance to the left shoulder is 1.5m and to the right shoulder is 14.0m."
        "</perception><prediction>Based on the past trajectory, the predicted trajectory 0.5s later is "
        "(-0.1,0.5), and the direction is Left.</prediction>"
        f"<visual>{codes} These are the visual tokens of CAM_FRONT_LEFT image at the 0.5 second in the "
        "future.</visual><think>Notable Objects: pedestrian at (-4.5, 3.2). Potential Effects: within the "
        "safe zone of the ego-vehicle at 2.0 second.</think>"
        "<action>TURN LEFT WITH A QUICK ACCELERATION</action>"
        f"<answer>[{points}]</answer><|im_end|>"
    )


@given(st.data())
@settings(max_examples=40)
def test_what_is_rendered_parses_to_the_same_values(data: st.DataObject) -> None:
    values = data.draw(values_of(compiled()))
    assert parse(compiled(), written(values)) == values


@given(st.data())
@settings(max_examples=5)
def test_what_is_rendered_can_be_written_by_the_cursor(data: st.DataObject) -> None:
    cursor = compiled().start()
    for token in compiled().render(data.draw(values_of(compiled()))):
        assert token.id in cursor.allowed().ids
        cursor = cursor.advance(token.id)
    assert cursor.done


def test_a_picture_is_98_codes_and_nothing_else() -> None:
    sections = [token.section for token in compiled().render(SAMPLE)]
    assert list(dict.fromkeys(sections)) == list(VLA_WORLD_FORMAT.sections())
    assert (VISUAL_CODES, VISUAL_SIZE) == (CODES, CODEBOOK_SIZE)
    text = written(SAMPLE)
    for wrong in (text.replace("<|v_97|>", ""), text.replace("<|v_97|>", "<|v_97|><|v_97|>")):
        with pytest.raises(FormatError):
            parse(compiled(), wrong)
    with pytest.raises(FormatError):
        CompiledFormat(VLA_WORLD_FORMAT, ImaginingVocabulary(999))


def test_every_camera_can_be_asked_for() -> None:
    assert set(CAMERA_OPTIONS) == set(CAMERAS)
    assert CAMERA_OPTIONS["front_left"] == "CAM_FRONT_LEFT"


@given(st.lists(st.tuples(st.floats(-49, 119), st.floats(-49, 49)), min_size=1, max_size=6))
def test_points_are_told_to_a_twentieth_of_a_metre(points: list[tuple[float, float]]) -> None:
    np.testing.assert_allclose(read_points(told_points(points)), points, atol=0.0501)


def test_points_beyond_are_at_the_border_and_left_is_negative() -> None:
    assert told_points([[10.0, 2.0], [500.0, -500.0]]) == (
        {"lateral_m": -2.0, "forward_m": 10.0},
        {"lateral_m": 50.0, "forward_m": 120.0},
    )
    with pytest.raises(FormatError, match="finite"):
        told_points([[np.nan, 0.0]])


@pytest.mark.parametrize(
    ("speed", "yaw_rate"), [(8.0, 0.0), (8.0, 0.3), (-2.0, 0.0), (-2.0, 0.2), (0.0, 0.0)]
)
def test_headings_follow_the_way(speed: float, yaw_rate: float) -> None:
    _, history = drive(speed, yaw_rate)
    rows = [round(time_s / 0.1) - 1 for time_s in TIMES_S]
    expected = constant_turn_rate(history)[rows]
    trajectory = read_trajectory(told_points(expected[:, :2]))
    np.testing.assert_allclose(trajectory[:, :2], expected[:, :2], atol=0.0501)
    # Each is the heading of the chord behind, half a step's turn late, and of rounded points.
    assert np.abs(trajectory[:, 3] - expected[:, 3]).max() < abs(yaw_rate) * 0.25 + 0.11
