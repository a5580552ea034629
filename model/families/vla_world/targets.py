"""What a labelled scene teaches VLA-World, and how much each of its sections weighs."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from looktwice.model.driving.perceived import PerceivedAgent
from looktwice.model.driving.trajectory import TEN_HZ_S, at_times
from looktwice.model.families.family import FamilyError, Lesson
from looktwice.model.families.picture_codes import beside
from looktwice.model.families.vla_world import format as its
from looktwice.model.families.vla_world.actions import action_of
from looktwice.model.formats.pieces import Value, Values

WEIGHTS: Final[Mapping[str, float]] = MappingProxyType(dict.fromkeys(its.VLA_WORLD_FORMAT.sections(), 1.0))
"""The paper weighs all tokens of a response alike."""
PICTURE_WEIGHTS: Final[Mapping[str, float]] = MappingProxyType(
    dict.fromkeys(its.VLA_WORLD_FORMAT.sections(), 0.0) | {its.VISUAL: 1.0}
)
"""Of visual pre-training (section 3.3): the picture alone, behind what is perceived and predicted."""


def teach(lesson: Lesson) -> Values:
    """What is perceived, where the expert is in half a second, who comes near, and what the expert does.

    A picture is taught where the lesson has one; otherwise that none is imagined. Raises `FamilyError` where
    the scene does not say what there is to perceive.
    """
    perceived = lesson.perceived
    if perceived is None:
        raise FamilyError("nothing to perceive: the scene lacks the edges of the road")
    waypoints = at_times(lesson.future, TEN_HZ_S, its.TIMES_S)[:, :2]
    action, points = action_of(waypoints), its.point_values(waypoints)
    agents = perceived.agents[: its.MAX_OBJECTS]
    objects = tuple(
        {"kind": agent.kind, "object_id": float(number), **_place(agent), **_size(agent)}
        for number, agent in enumerate(agents, 1)
    )
    shoulders = (its.SHOULDER_M.nearest(side_m) for side_m in (perceived.left_m, perceived.right_m))
    values: dict[str, tuple[Value, ...]] = {
        its.PERCEPTION: (objects, *shoulders),
        its.PREDICTION: (points[0], action.direction),
        its.IMAGINE: (its.UNSEEN,),
        its.THINK: (_notable(agents),),
        its.ACTION: ({"lateral": action.lateral, "speed": action.speed},),
        its.ANSWER: (points,),
    }
    picture = lesson.next_picture
    if picture is not None:
        values[its.IMAGINE] = (its.IMAGINED,)
        values[its.VISUAL] = (beside(lesson.expected, picture.codes), its.CAMERA_OPTIONS[picture.camera])
    return Values(values)


def _place(agent: PerceivedAgent) -> Mapping[str, float]:
    [point] = its.point_values([[agent.x_m, agent.y_m]])
    return point


def _size(agent: PerceivedAgent) -> Mapping[str, float]:
    return {"width_m": its.SIZE_M.nearest(agent.width_m), "length_m": its.SIZE_M.nearest(agent.length_m)}


def _notable(agents: tuple[PerceivedAgent, ...]) -> tuple[Value, ...]:
    """Who comes into the safe zone: the soonest first, and of those the nearest."""
    near = [(agent.near_s, agent) for agent in agents if agent.near_s is not None]
    near.sort(key=lambda each: each[0])
    return tuple(
        {"kind": agent.kind, **_place(agent), "time_s": near_s} for near_s, agent in near[: its.MAX_NOTABLE]
    )
