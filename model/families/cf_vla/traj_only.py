"""CF-VLA's baseline: the trajectory at once, without a plan."""

from typing import Final

from looktwice.model.families.cf_vla.format import ACTION, TRAJECTORY
from looktwice.model.families.family import Decode, Family, Lesson, Reading
from looktwice.model.families.trajectory_codes import TRAJECTORY_CODES, codes_in
from looktwice.model.formats.pieces import Format, Literal, Section, Sequence, Values


def read(values: Values, decode: Decode) -> Reading:
    """The trajectory of a response."""
    codes = codes_in(values[TRAJECTORY])
    return Reading(decode(codes), codes)


def teach(lesson: Lesson) -> Values:
    """The expert's trajectory."""
    return Values.of({TRAJECTORY: lesson.codes})


TRAJ_ONLY: Final = Family(
    format=Format("traj_only", Section(TRAJECTORY, Sequence((Literal(ACTION), TRAJECTORY_CODES)))),
    task="Give the trajectory.",
    trajectory=TRAJECTORY,
    read=read,
    title="traj-only",
    about="gives 6.4 s of trajectory at once",
    teach=teach,
)
"""trajectory"""
