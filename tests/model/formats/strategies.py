"""Random plans, responses and formats."""

from __future__ import annotations

import string
from itertools import pairwise

from hypothesis import strategies as st

from model.driving.plan import GROUPS, TICKS, WORDS, Group, MetaAction, Plan, plan_from_bins
from model.formats.pieces import (
    ACTION,
    BRANCH,
    CODES,
    MAX_SEGMENTS,
    THINKING,
    Choice,
    Codes,
    Format,
    FreeText,
    Literal,
    Option,
    Piece,
    PlanTracks,
    Section,
    Sequence,
    Value,
    Values,
)


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


_LEADS = st.text(string.ascii_letters + " :,", max_size=30).map(Literal)
_STOPS = st.sampled_from(["\n", "\n\n", "\nSo:\n"])
# Written with a mark behind, so that none is the beginning of another.
_MOODS = ("calm", "hasty", "wary", "lost in thought", "lost", "calmer than before")


@st.composite
def branching_formats(draw: st.DrawFn) -> Format:
    """Formats with a plan and a branch, and by chance with notes and words to choose from in other places."""

    def text(name: str) -> Section:
        return Section(name, Sequence((draw(_LEADS), FreeText(draw(_STOPS), draw(st.integers(1, 60))))))

    def plan(name: str, groups: tuple[Group, ...]) -> Section:
        return Section(name, Sequence((draw(_LEADS), Literal("\n"), PlanTracks(groups))))

    def mood(then: Piece) -> Section:
        words = draw(st.lists(st.sampled_from(_MOODS), unique=True, min_size=1))
        options = tuple(Option(f" {word};", Literal(draw(st.sampled_from(["", "!\n"])))) for word in words)
        name = draw(st.sampled_from([None, "mood"]))
        return Section("mood", Sequence((Literal("Mood:"), Choice(options, name), then)))

    some = draw(st.sets(st.sampled_from(GROUPS), min_size=1))
    groups = tuple(group for group in GROUPS if group in some)
    end = Section("trajectory", Sequence((draw(_LEADS), Codes(), Literal("<|im_end|>"))))
    before = [text("note")] if draw(st.booleans()) else []
    between = [mood(draw(_LEADS))] if draw(st.booleans()) else []
    again = draw(st.lists(st.sampled_from(["revised", "mood", "note"]), unique=True))
    made: dict[str, Piece] = {
        "revised": plan("revised_plan", groups),
        "mood": mood(Literal("")),
        "note": text("second_note"),
    }
    ways = (
        Option(ACTION, end),
        Option(THINKING, Sequence((text("thinking"), *(made[name] for name in again), end))),
    )
    branch = Section(BRANCH, Choice(tuple(draw(st.permutations(ways))), BRANCH))
    return Format("made up", Sequence((*before, plan("plan", groups), *between, branch)))
