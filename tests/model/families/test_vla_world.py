from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.perceived import Perceived, PerceivedAgent
from looktwice.model.driving.scene import CAMERAS
from looktwice.model.driving.trajectory import constant_turn_rate
from looktwice.model.families.family import FamilyError, Foreseen, Lesson, NextPicture, Reading, Situation
from looktwice.model.families.picture_codes import PICTURE, PICTURE_CODEBOOK, PICTURE_CODES, beside
from looktwice.model.families.vla_world import VLA_WORLD
from looktwice.model.families.vla_world.actions import action_of, counted
from looktwice.model.families.vla_world.format import (
    CAMERA_OPTIONS,
    FORWARD_M,
    IMAGINED,
    LATERAL_M,
    SHOULDER_M,
    SIZE_M,
    TIMES_S,
    UNSEEN,
    VLA_WORLD_FORMAT,
    VLA_WORLD_TOKENS,
    point_values,
    read_points,
    read_trajectory,
    thoughts_text,
)
from looktwice.model.families.vla_world.inputs import describe
from looktwice.model.families.vla_world.read import read
from looktwice.model.families.vla_world.rewards import REWARDS, STEADY_SHARE, rewards
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.formats.pieces import FormatError, Values
from looktwice.model.formats.text import parse
from tests.model.driving.drives import MIDDLES_S, drive, labelled_scene
from tests.model.driving.test_perceived import PERCEIVED
from tests.model.formats.strategies import values_of
from tests.model.formats.vocabulary import ByteVocabulary

NUMBERS = {str(number.name): len(number.texts) for number in (LATERAL_M, FORWARD_M, SIZE_M, SHOULDER_M)}
CODE = re.compile(r"<\|\w+\|>")


class ImaginingVocabulary(ByteVocabulary):
    """With alphabets of codes of pictures and of metres."""

    def __init__(self, size: int = PICTURE_CODEBOOK) -> None:
        super().__init__()
        for name, count in {PICTURE: size, **NUMBERS}.items():
            first = len(self.texts)
            self.texts += [f"<|{name}_{code}|>" for code in range(count)]
            self.alphabets[name] = (range(first, first + count),)
            self._ids |= {text: first + code for code, text in enumerate(self.texts[first:])}

    def encode(self, text: str) -> tuple[int, ...]:
        # Codes are only ever written one by one.
        return (self._ids[text],) if text in self._ids and CODE.fullmatch(text) else super().encode(text)


VOCABULARY = ImaginingVocabulary()


@cache
def compiled(tokens: bool = False) -> CompiledFormat:
    return CompiledFormat(VLA_WORLD_TOKENS if tokens else VLA_WORLD_FORMAT, VOCABULARY)


END = "]</answer><|im_end|>"
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
        "imagine": (IMAGINED,),
        "visual": (beside(None, range(PICTURE_CODES)), "CAM_FRONT_LEFT"),
        "think": (({"kind": "pedestrian", "lateral_m": -4.5, "forward_m": 3.2, "time_s": 2.0},),),
        "action": ({"lateral": "TURN LEFT", "speed": "A QUICK ACCELERATION"},),
        "answer": ((POINT,) * 6,),
    }
)


def written(values: Values, tokens: bool = False) -> str:
    return VOCABULARY.decode([token.id for token in compiled(tokens).render(values)])


def test_the_papers_sample() -> None:
    """Figure 5b, rounded to 0.1 m."""
    codes = "".join(f"<|visual_500|><|visual_{code}|>" for code in range(PICTURE_CODES))
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


def test_metres_may_be_tokens() -> None:
    text = written(SAMPLE, tokens=True)
    assert "object id: 1, position: (<|lateral_m_455|>, <|forward_m_532|>), size: (<|size_m_6|>, " in text
    assert "left shoulder is <|shoulder_m_15|>m" in text
    assert text.endswith("<answer>[" + ", ".join(["(<|lateral_m_499|>,<|forward_m_505|>)"] * 6) + END)
    assert len(compiled(tokens=True).render(SAMPLE)) < len(compiled().render(SAMPLE))


def test_it_need_not_imagine() -> None:
    unseen = Values({name: values for name, values in SAMPLE.by_section.items() if name != "visual"})
    text = written(Values({**unseen.by_section, "imagine": (UNSEEN,)}))
    assert "direction is Left.</prediction>\n<think>Notable" in text
    assert "<visual>" not in text
    # One token decides it, as controls need it.
    assert IMAGINED[0] != UNSEEN[0]
    with pytest.raises(FormatError):
        written(unseen)


@pytest.mark.parametrize("tokens", [False, True])
@given(st.data())
@settings(max_examples=40)
def test_what_is_rendered_parses_to_the_same_values(tokens: bool, data: st.DataObject) -> None:
    values = data.draw(values_of(compiled(tokens)))
    assert parse(compiled(tokens), written(values, tokens)) == values


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
    text = written(SAMPLE)
    for wrong in (
        text.replace("<|visual_97|>", ""),
        text.replace("<|visual_97|>", "<|visual_97|><|visual_97|>"),
    ):
        with pytest.raises(FormatError):
            parse(compiled(), wrong)
    with pytest.raises(FormatError):
        CompiledFormat(VLA_WORLD_FORMAT, ImaginingVocabulary(999))


def test_thoughts_are_read_in_the_words_that_are_written() -> None:
    reading = read(SAMPLE, lambda codes: pytest.fail("there are no codes"))
    assert VLA_WORLD.reflected(SAMPLE) == thoughts_text(SAMPLE["think"])
    assert f"<think>{VLA_WORLD.reflected(SAMPLE)}</think>" in written(SAMPLE)
    assert (reading.trajectory.shape, reading.codes, reading.branch) == ((6, 4), (), None)
    np.testing.assert_allclose(reading.trajectory[:, :2], [[0.5, 0.1]] * 6, rtol=1e-6)
    silent = Values({**SAMPLE.by_section, "think": ((),)})
    assert VLA_WORLD.reflected(silent) is None


def test_every_camera_can_be_asked_for() -> None:
    assert set(CAMERA_OPTIONS) == set(CAMERAS)
    assert CAMERA_OPTIONS["front_left"] == "CAM_FRONT_LEFT"


@given(st.lists(st.tuples(st.floats(-49, 119), st.floats(-49, 49)), min_size=1, max_size=6))
def test_points_are_told_to_a_twentieth_of_a_metre(points: list[tuple[float, float]]) -> None:
    np.testing.assert_allclose(read_points(point_values(points)), points, atol=0.0501)


def test_points_beyond_are_at_the_border_and_left_is_negative() -> None:
    assert point_values([[10.0, 2.0], [500.0, -500.0]]) == (
        {"lateral_m": -2.0, "forward_m": 10.0},
        {"lateral_m": 50.0, "forward_m": 120.0},
    )
    with pytest.raises(FormatError, match="finite"):
        point_values([[np.nan, 0.0]])


@pytest.mark.parametrize(
    ("speed", "yaw_rate"), [(8.0, 0.0), (8.0, 0.3), (-2.0, 0.0), (-2.0, 0.2), (0.0, 0.0)]
)
def test_headings_follow_the_way(speed: float, yaw_rate: float) -> None:
    _, history = drive(speed, yaw_rate)
    rows = [round(time_s / 0.1) - 1 for time_s in TIMES_S]
    expected = constant_turn_rate(history)[rows]
    trajectory = read_trajectory(point_values(expected[:, :2]))
    np.testing.assert_allclose(trajectory[:, :2], expected[:, :2], atol=0.0501)
    # Each is the heading of the chord behind, half a step's turn late, and of rounded points.
    assert np.abs(trajectory[:, 3] - expected[:, 3]).max() < abs(yaw_rate) * 0.25 + 0.11


FUTURE, HISTORY = drive(np.maximum(0, 12 - 2 * np.maximum(MIDDLES_S, 0)), 0.05)
SEEN = Perceived(
    (
        PerceivedAgent("vehicle", 12.0, 3.52, 4.5, 1.8, None),
        PerceivedAgent("pedestrian", 14.0, -4.5, 0.7, 0.7, 2.0),
        PerceivedAgent("vehicle", 30.0, 0.0, 4.5, 1.8, 1.5),
        PerceivedAgent("barrier", 31.0, 0.0, 1.0, 25.0, 2.0),
    ),
    left_m=2.04,
    right_m=np.inf,
)


def lesson(perceived: Perceived | None = SEEN, picture: NextPicture | None = None) -> Lesson:
    plan = expert_plan(labelled_scene())
    return Lesson(plan, (0,) * 6, FUTURE, perceived=perceived, next_picture=picture)


def taught(given: Lesson) -> Values:
    assert VLA_WORLD.teach is not None
    return VLA_WORLD.teach(given)


def test_what_a_scene_teaches() -> None:
    assert written(taught(lesson())) == (
        "<perception>Object detections: object type: vehicle, object id: 1, position: (-3.5, 12.0), "
        "size: (1.8, 4.5); object type: pedestrian, object id: 2, position: (4.5, 14.0), size: (0.7, 0.7); "
        "object type: vehicle, object id: 3, position: (0.0, 30.0), size: (1.8, 4.5); "
        "object type: barrier, object id: 4, position: (0.0, 31.0), size: (20.0, 1.0). "
        "Distance to the left shoulder is 2.0m and to the right shoulder is 50.0m.</perception>"
        "<prediction>Based on the past trajectory, the predicted trajectory 0.5s later is (-0.1,5.7), and "
        "the direction is Forward.</prediction>\n"
        # The soonest first, and then the nearest.
        "<think>Notable Objects: vehicle at (0.0, 30.0). Potential Effects: within the safe zone of the "
        "ego-vehicle at 1.5 second. Notable Objects: pedestrian at (4.5, 14.0). Potential Effects: within "
        "the safe zone of the ego-vehicle at 2.0 second. Notable Objects: barrier at (0.0, 31.0). Potential "
        "Effects: within the safe zone of the ego-vehicle at 2.0 second.</think>"
        "<action>MOVE FORWARD WITH A DECELERATION</action>"
        "<answer>[(-0.1,5.7), (-0.3,11.0), (-0.6,15.7), (-0.9,20.0), (-1.4,23.7), (-1.8,26.9)]</answer>"
        "<|im_end|>"
    )


def test_a_picture_is_taught_where_there_is_one() -> None:
    codes = tuple(range(PICTURE_CODES))
    values = taught(lesson(picture=NextPicture("front_left", codes)))
    assert values.all("visual") == (beside(None, codes), "CAM_FRONT_LEFT")
    assert "<visual><|visual_500|><|visual_0|><|visual_500|><|visual_1|>" in written(values)
    known = taught(replace(lesson(picture=NextPicture("front_left", codes)), expected=codes[::-1]))
    assert "<visual><|visual_97|><|visual_0|><|visual_96|><|visual_1|>" in written(known)
    with pytest.raises(FamilyError, match="unknown camera 'roof'; known are front_wide_120, "):
        NextPicture("roof", codes)
    with pytest.raises(ValueError, match="shorter"):
        taught(lesson(picture=NextPicture("front_left", codes[1:])))


def test_nothing_is_taught_where_nothing_is_perceived() -> None:
    with pytest.raises(FamilyError, match="lacks the edges of the road"):
        taught(lesson(None))


@pytest.mark.parametrize("tokens", [False, True])
@given(perceived=PERCEIVED)
def test_what_is_taught_reads_back(tokens: bool, perceived: Perceived) -> None:
    values = taught(lesson(perceived))
    assert parse(compiled(tokens), written(values, tokens)) == values
    trajectory = read(values, lambda codes: pytest.fail("there are no codes")).trajectory
    np.testing.assert_allclose(trajectory[:, :2], FUTURE[4:30:5, :2], atol=0.0501)


@given(st.floats(0, 15), st.floats(-0.3, 0.3), PERCEIVED)
def test_mirrored_lessons_teach_mirrored_responses(
    speed: float, yaw_rate: float, perceived: Perceived
) -> None:
    future, _ = drive(speed, yaw_rate)
    straight = taught(replace(lesson(perceived), future=future))
    mirrored = replace(lesson(perceived.mirrored()), future=drive(speed, -yaw_rate)[0])
    theirs = taught(mirrored)
    # What lies between two numbers of the grid is rounded one way.
    np.testing.assert_allclose(
        read_points(theirs["answer"]), read_points(straight["answer"]) * [1, -1], atol=0.101
    )
    swapped = {"TURN LEFT": "TURN RIGHT", "TURN RIGHT": "TURN LEFT"}
    action = cast("dict[str, str]", straight["action"])
    assert theirs["action"] == action | {"lateral": swapped.get(action["lateral"], action["lateral"])}
    assert theirs.all("perception")[1:] == straight.all("perception")[:0:-1]


def points_at(*speeds_ms: float, left_m: float = 0.0) -> list[list[float]]:
    return [[0.5 * sum(speeds_ms[: step + 1]), left_m * step / 5] for step in range(6)]


@pytest.mark.parametrize(
    ("waypoints", "lateral", "speed"),
    [
        (points_at(*[8.0] * 6), "MOVE FORWARD", "A CONSTANT SPEED"),
        (points_at(*[8.0] * 6, left_m=1.9), "MOVE FORWARD", "A CONSTANT SPEED"),
        (points_at(*[8.0] * 6, left_m=2.1), "TURN LEFT", "A CONSTANT SPEED"),
        (points_at(*[8.0] * 6, left_m=-2.1), "TURN RIGHT", "A CONSTANT SPEED"),
        (points_at(8.0, 8.3, 8.6, 8.9, 9.2, 9.5), "MOVE FORWARD", "AN ACCELERATION"),
        (points_at(2.0, 3.0, 4.0, 5.0, 6.0, 7.0), "MOVE FORWARD", "A QUICK ACCELERATION"),
        (points_at(9.0, 8.5, 8.0, 7.5, 7.0, 6.5), "MOVE FORWARD", "A DECELERATION"),
        (points_at(9.0, 8.0, 7.0, 6.0, 5.0, 4.0), "MOVE FORWARD", "A QUICK DECELERATION"),
        (points_at(5.0, 4.0, 3.0, 2.0, 1.0, 0.0), "MOVE FORWARD", "A DECELERATION TO ZERO"),
        (points_at(*[0.0] * 6), "MOVE FORWARD", "A DECELERATION TO ZERO"),
        (
            # The paper's sample, (lateral, forward): "TURN LEFT WITH A QUICK ACCELERATION".
            read_points(
                tuple(
                    {"lateral_m": x, "forward_m": y}
                    for x, y in [
                        *((-0.06, 0.56), (-0.21, 1.36), (-0.53, 2.47)),
                        *((-1.08, 3.68), (-2.03, 5.11), (-3.26, 6.40)),
                    ]
                )
            ),
            "TURN LEFT",
            "A QUICK ACCELERATION",
        ),
    ],
)
def test_what_waypoints_do(waypoints: list[list[float]], lateral: str, speed: str) -> None:
    action = action_of(waypoints)
    assert (action.lateral, action.speed) == (lateral, speed)
    assert action.direction.upper() == lateral.split()[-1]


def test_prompts_say_the_ego_status_in_the_papers_axes() -> None:
    assert VLA_WORLD.inputs is not None
    text = CompiledFormat(VLA_WORLD.inputs.format, VOCABULARY)
    route = np.stack([np.arange(4.0, 84.0, 4.0), np.full(20, -2.5)], 1).astype(np.float32)
    for known, goal, camera, asked in (
        (route, "RIGHT", None, "ANY"),
        (route * 0, "FORWARD", "front", "CAM_FRONT"),
        (-route, "LEFT", "back_left", "CAM_BACK_LEFT"),
        (None, "UNKNOWN", None, "ANY"),
    ):
        told = text.render(describe(Situation(HISTORY, known, camera=camera)))
        assert VOCABULARY.decode([token.id for token in told]) == (
            "Velocity: 12.0 m/s Heading Angular Velocity: 0.05 rad/s Acceleration: 0.0 m/s2\n"
            "Historical Trajectory: [(-0.7,-18.0), (-0.3,-12.0), (-0.1,-6.0)]\n"
            f"Mission Goal: {goal}\n"
            f"Camera: {asked}\n"
        )


def reading_of(waypoints: list[list[float]], **foreseen: Any) -> Reading:
    """A response that does what its waypoints do, and foresees the first of them."""
    action = action_of(waypoints)
    x_m, y_m = waypoints[0]
    told = {"x_m": x_m, "y_m": y_m, "direction": action.direction} | foreseen
    seen = Foreseen(SEEN, picture=None, **told)
    return Reading(read_trajectory(point_values(waypoints)), foreseen=seen, action=counted(action))


EXPERT = FUTURE[4:30:5, :2].tolist()


def test_the_experts_own_response_is_worth_everything() -> None:
    found = rewards(FUTURE, reading_of(EXPERT))
    assert tuple(found) == REWARDS
    # Waypoints are rounded to 0.1 m, which is 0.4 m/s² in an acceleration.
    assert found == pytest.approx({"prediction": 1, "action": 1, "waypoints": 1}, abs=0.1)


def test_each_reward_is_lost_by_its_own_fault() -> None:
    right = rewards(FUTURE, reading_of(EXPERT))
    for worse, part in (
        (reading_of(EXPERT, x_m=EXPERT[0][0] + 0.5), "prediction"),
        (reading_of(EXPERT, direction="Left"), "prediction"),
        (replace(reading_of(EXPERT), action=("left", "decelerate")), "action"),
        (replace(reading_of(EXPERT), action=("forward", "keep")), "action"),
    ):
        found = rewards(FUTURE, worse)
        assert {name for name in REWARDS if found[name] < right[name] - 1e-6} == {part}
    assert rewards(FUTURE, replace(reading_of(EXPERT), action=("left", "keep")))["action"] == 0


def test_a_trajectory_loses_by_distance_and_by_jerks() -> None:
    def worth(waypoints: list[list[float]]) -> float:
        return rewards(FUTURE, reading_of(waypoints))["waypoints"]

    ever_farther = [
        worth([[x + off * time_s, y] for (x, y), time_s in zip(EXPERT, TIMES_S, strict=True)])
        for off in (0.0, 0.5, 1.0, 2.0, 4.0)
    ]
    assert ever_farther == sorted(ever_farther, reverse=True)
    # So far off nothing is left but that it is steady.
    assert ever_farther[-2:] == pytest.approx([STEADY_SHARE] * 2, abs=0.1)
    jerky = [[x + (0.3 if step % 2 else -0.3), y] for step, (x, y) in enumerate(EXPERT)]
    aside = [[x + 0.3, y] for x, y in EXPERT]
    assert worth(jerky) < worth(aside) - 0.8 * STEADY_SHARE


def test_responses_that_foresee_nothing_have_no_rewards() -> None:
    with pytest.raises(FamilyError, match="nothing is foreseen"):
        rewards(FUTURE, Reading(read_trajectory(point_values(EXPERT))))
