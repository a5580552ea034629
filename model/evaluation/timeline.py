"""Plans drawn as three-track timelines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch

from looktwice.model.driving.plan import GROUPS, TICKS, MetaAction, Plan

WORD_COLOURS: Final[Mapping[str, str]] = {
    "Accelerate": "#2f9e6e",
    "Decelerate": "#e2703a",
    "Keep Speed": "#b9c4cf",
    "Wait": "#5b6470",
    "Reverse": "#8a63b8",
    "Straight": "#d3dae1",
    "Left Turn": "#3f7fc4",
    "Right Turn": "#c9a227",
    "Keep Lane": "#d3dae1",
    "Left Lane Change": "#7aaee0",
    "Right Lane Change": "#e3c766",
}
_DARK_WORDS: Final = frozenset({"Accelerate", "Decelerate", "Wait", "Reverse", "Left Turn", "Right Turn"})

_BLOCK_GAP: Final = 0.9
"""Rows between two plans."""
_TICKS_PER_LETTER: Final = 1.15
"""How wide a letter is at the sizes used here; longer words are left out of short segments."""


def row_count(plans: Sequence[object]) -> float:
    """How many rows high a timeline of that many plans is."""
    return len(plans) * len(GROUPS) + (len(plans) - 1) * _BLOCK_GAP


def draw_timeline(axes: Axes, plans: Sequence[tuple[str, Plan]]) -> None:
    """Draw named plans below each other; time runs to the right, 0.0 s to 6.4 s."""
    top = 0.0
    for name, plan in plans:
        axes.text(-10.2, top + 1.5, name, rotation=90, ha="center", va="center", fontsize=9, weight="bold")
        for row, group in enumerate(GROUPS):
            middle = top + row + 0.5
            axes.text(-0.8, middle, group, ha="right", va="center", fontsize=9, color="#4a5560")
            track = plan.track(group)
            if track is None:
                axes.text(
                    1, middle, "not spoken of", va="center", fontsize=8, color="#9aa5b0", style="italic"
                )
            for action in track or ():
                _draw_segment(axes, action, middle)
        top += len(GROUPS) + _BLOCK_GAP
    axes.set_xlim(0, TICKS)
    axes.set_ylim(top - _BLOCK_GAP, 0)
    seconds = range(0, TICKS, 10)
    axes.set_xticks(seconds, [f"{tick // 10} s" for tick in seconds])
    axes.set_yticks([])
    axes.tick_params(length=3, labelsize=8, colors="#4a5560")
    axes.grid(axis="x", color="#e6eaee", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["left", "right", "top"]].set_visible(False)
    axes.spines["bottom"].set_color("#9aa5b0")


def _draw_segment(axes: Axes, action: MetaAction, middle: float) -> None:
    axes.add_patch(
        FancyBboxPatch(
            (action.start + 0.15, middle - 0.4),
            action.end - action.start - 0.3,
            0.8,
            boxstyle="round,pad=0,rounding_size=0.25",
            facecolor=WORD_COLOURS[action.word],
            edgecolor="none",
        )
    )
    width = action.end - action.start
    shown = next(
        (text for text in _shorter(action.word) if len(text) * _TICKS_PER_LETTER <= width - 0.5), None
    )
    if shown is not None:
        axes.text(
            (action.start + action.end) / 2,
            middle,
            shown,
            ha="center",
            va="center",
            fontsize=8.5,
            color="white" if action.word in _DARK_WORDS else "#2b333b",
        )


def _shorter(word: str) -> list[str]:
    """A word and what may stand for it where there is little room."""
    first = word.split()[0]
    short = {"Accelerate": "Acc.", "Decelerate": "Dec.", "Reverse": "Rev."}.get(word, first)
    return [word, *([word.replace(" Lane Change", " change")] if "Change" in word else []), short]
