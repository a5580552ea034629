"""Random reflections in phrases."""

from __future__ import annotations

from hypothesis import strategies as st

from looktwice.model.driving.direction import group_of
from looktwice.model.driving.phrases import (
    FARTHEST_M,
    HEADS,
    STEP_M,
    Bend,
    Clear,
    Correction,
    Cue,
    Facts,
    Head,
    Junction,
    Room,
    Statement,
    Straight,
    Thing,
    change_of,
    consequences,
)
from looktwice.model.driving.plan import GROUPS, Group

_AHEAD = st.integers(1, FARTHEST_M // STEP_M).map(lambda steps: steps * STEP_M)
_PLACES = ("my lane", "the left lane", "the right lane", "the left side", "the right side")


@st.composite
def _cues(draw: st.DrawFn, head: Head) -> Cue:
    match head:
        case Bend(side):
            return Bend(side, draw(st.none() | _AHEAD))
        case Junction() | Room() | Straight() | Clear():
            return head
        case (kind, state):
            oncoming = ("oncoming",) if head == ("vehicle", "") else ()
            return Thing(kind, draw(st.sampled_from((*_PLACES, *oncoming))), draw(st.just(0) | _AHEAD), state)


@st.composite
def _statements(draw: st.DrawFn, group: Group) -> Statement:
    def fitting(corrections: tuple[Correction, ...]) -> list[Correction]:
        return [each for each in corrections if group_of(change_of(each)) == group]

    heads = [head for head in HEADS.values() if any(map(fitting, consequences(head).values()))]
    head = draw(st.sampled_from(heads))
    possible = [(name, each) for name, some in consequences(head).items() for each in fitting(some)]
    return Statement(draw(_cues(head)), *draw(st.sampled_from(possible)))


@st.composite
def facts(draw: st.DrawFn) -> Facts:
    """Any reflection that can be written."""
    groups = [group for group in GROUPS if draw(st.booleans())]
    return Facts(tuple(draw(_statements(group)) for group in groups))
