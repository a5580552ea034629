"""VLA-World: it says what is there, predicts half a second, imagines a picture of it, thinks, and acts."""

from typing import Final

from looktwice.model.families.family import Family, Imagination
from looktwice.model.families.vla_world import format as its
from looktwice.model.families.vla_world.actions import ACTIONS
from looktwice.model.families.vla_world.inputs import INPUTS
from looktwice.model.families.vla_world.read import (
    expecting,
    perceived,
    pictured,
    predicted,
    predicting,
    read,
    thoughts_text,
)
from looktwice.model.families.vla_world.rewards import rewards
from looktwice.model.families.vla_world.targets import teach

_TASK: Final = (
    "Coordinates: X-axis is perpendicular, and Y-axis is parallel to the direction you're facing. You're at "
    "point (0,0). Units: meters. Traffic Rules: Avoid collision with other objects. Please perceive, predict "
    "0.5 second, think about it, and plan waypoints (0.5s intervals) for the next 3 seconds."
)
"""Figure 5, shortened."""

VLA_WORLD: Final = Family(
    format=its.VLA_WORLD_FORMAT,
    dialects={"phrases": its.VLA_WORLD_TOKENS},
    task=_TASK,
    inputs=INPUTS,
    trajectory=its.ANSWER,
    reflection=its.THINK,
    reflection_text=thoughts_text,
    read=read,
    times_s=its.TIMES_S,
    teach=teach,
    lesson_needs=("perceived",),
    title="perceive-think-answer",
    about="says what is around, may paint what a camera will see, and gives waypoints over 3 s",
    imagination=Imagination(
        *(its.IMAGINE, its.IMAGINED, its.UNSEEN, its.CAMERA),
        cameras=its.CAMERA_OPTIONS,
        section=its.VISUAL,
        perception=its.PERCEPTION,
        prediction=its.PREDICTION,
        perceived=perceived,
        predicted=predicted,
        pictured=pictured,
        predicting=predicting,
        expecting=expecting,
    ),
    unthought={its.THINK: ((),)},
    actions=ACTIONS,
    rewards=rewards,
)
"""perception, prediction, a picture or none, think, action, answer"""
