"""Whose turn a step is. No torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

from model.engines.torch.pace import Pace
from model.engines.torch.rows import Request
from model.engines.torch.schedule import urgency

_SLACK: Final = 1.25
"""So many times what it needs is left to the most urgent request: rows part, and steps vary."""


class Work(NamedTuple):
    """What is left to do for a running request.

    Attributes:
        request: whose.
        passes: until all its draws have a trajectory, if only a draft; 0 where they have.
        rows: that write its draws once these have parted.
        prompts: to be read first.
    """

    request: Request
    passes: float
    rows: int
    prompts: int


def turn(works: Sequence[Work], pace: Pace, now_s: float) -> list[Request]:
    """The requests that go on in this step, the most urgent first.

    Those are all where the most urgent one is in time beside them, else as many of the most urgent ones as
    leave it the time: where each request makes a pass longer, going on with all would make all late. One
    that cannot be in time any more even alone waits like one without a deadline, and a second look behind
    those that have nothing to answer with yet.
    """

    def needed_s(work: Work, beside: Sequence[Work]) -> float:
        prompts = sum(each.prompts for each in beside)
        rows = sum(each.rows for each in beside)
        return prompts * pace.prompt_s + work.passes * pace.pass_s(rows)

    if all(work.request.controls.deadline_ms is None for work in works):
        return [work.request for work in sorted(works, key=lambda work: urgency(work.request, now_s))]
    order = sorted(
        works,
        key=lambda work: (work.passes == 0, urgency(work.request, now_s + needed_s(work, [work]))),
    )
    left_s = order[0].request.deadline_s - now_s
    many = len(order)
    if order[0].passes and needed_s(order[0], order[:1]) <= left_s:
        while many > 1 and _SLACK * needed_s(order[0], order[:many]) > left_s:
            many -= 1
    return [work.request for work in order[:many]]
