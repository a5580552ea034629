"""CF-VLA's baseline: the trajectory at once, without a plan."""

from typing import Final

from model.families.cf_vla.format import ACTION, TRAJECTORY
from model.families.family import Family
from model.families.trajectory_codes import TRAJECTORY_CODES
from model.formats.pieces import Format, Literal, Section, Sequence

TRAJ_ONLY: Final = Family(
    format=Format("traj_only", Section(TRAJECTORY, Sequence((Literal(ACTION), TRAJECTORY_CODES)))),
    task="Give the trajectory.",
    trajectory=TRAJECTORY,
)
"""trajectory"""
