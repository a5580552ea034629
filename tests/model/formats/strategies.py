"""Random plans and responses."""

from __future__ import annotations

import string
from itertools import pairwise

from hypothesis import strategies as st

from model.driving.plan import GROUPS, TICKS, WORDS, MetaAction, Plan, plan_from_bins
from model.formats.pieces import CODES, MAX_SEGMENTS, Value, Values


@st.composite
def plans(draw: st.DrawFn) -> Plan:
    """Plans with all three groups, equal neighbours joined."""
    tracks = {}
    for group in GROUPS:
        cuts = draw(st.sets(st.integers(1, TICKS - 1), max_size=MAX_SEGMENTS - 1))
        edges = [0, *sorted(cuts), TICKS]
        tracks[group] = tuple(
            MetaAction(start, end, draw(st.sampled_from(WORDS[group]))) for start, end in pairwise(edges)
        )
    return plan_from_bins(Plan(**tracks).bins())


@st.composite
def cf_vla_values(draw: st.DrawFn, codes: int = 16) -> Values:
    """Values of a whole CF-VLA response."""
    values: dict[str, Value] = {
        "plan": draw(plans()),
        "branch": draw(st.sampled_from(["Action:", "Thinking:"])),
        "trajectory": tuple(draw(st.lists(st.integers(0, codes - 1), min_size=CODES, max_size=CODES))),
    }
    if values["branch"] == "Thinking:":
        alphabet = string.ascii_letters + string.digits + " ,.-"
        values["thinking"] = draw(st.text(alphabet, min_size=1, max_size=60))
        values["revised_plan"] = draw(plans())
    return values
