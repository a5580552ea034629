"""Which change of a plan is spoken of first: the one that would have kept it from failing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from model.driving.direction import Change
from model.driving.outcome import FailureName, Outcome

_BESIDE: Final[tuple[Change, ...]] = ("keep_lane", "lane_left", "lane_right")
_REMEDIES: Final[Mapping[FailureName, tuple[Change, ...]]] = {
    "collision": ("slower", *_BESIDE),
    "off_road": ("left", "right", "straight", *_BESIDE, "slower"),
    "off_route": ("left", "right", "straight", *_BESIDE, "slower"),
    "comfort": ("slower",),
    "behind": ("faster", "lane_left", "lane_right"),
    "ahead": ("slower",),
}
"""What helps against each failure, the likeliest first."""


def remedies_first(changes: Sequence[frozenset[Change]], outcome: Outcome | None) -> list[frozenset[Change]]:
    """Changes of a plan, those first that help against what it fails at; in their order otherwise.

    Args:
        changes: see `model.driving.direction.wanted_changes`.
        outcome: what the plan comes to; None where nobody has followed it.
    """
    if outcome is None:
        return list(changes)
    wanted = list(dict.fromkeys(change for name in outcome.fails for change in _REMEDIES[name]))

    def place(each: frozenset[Change]) -> int:
        return min((wanted.index(change) for change in each if change in wanted), default=len(wanted))

    return sorted(changes, key=place)
