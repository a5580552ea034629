"""What a response of CF-VLA says."""

from __future__ import annotations

from looktwice.model.driving.plan import Plan
from looktwice.model.families.cf_vla.format import BRANCH, PLAN, REVISED_PLAN, TRAJECTORY
from looktwice.model.families.family import Decode, Reading
from looktwice.model.families.trajectory_codes import codes_in
from looktwice.model.formats.pieces import Values


def read(values: Values, decode: Decode) -> Reading:
    """The parts of a response; raises `FormatError` where a section holds several values."""
    codes = codes_in(values[TRAJECTORY])
    plan, revised = values.get(PLAN), values.get(REVISED_PLAN)
    branch = values.get(BRANCH)
    return Reading(
        trajectory=decode(codes),
        codes=codes,
        plan=plan if isinstance(plan, Plan) else None,
        branch=branch if isinstance(branch, str) else None,
        revised_plan=revised if isinstance(revised, Plan) else None,
    )
