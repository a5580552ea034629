"""Whose turn a step is. No torch."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import chain
from typing import Final, NamedTuple

from model.engines.torch.pace import Pace
from model.engines.torch.rows import Request, Row
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


def works(
    rows: Sequence[Row], reading: Sequence[Sequence[Row]], drafts: Collection[tuple[str, int]], pace: Pace
) -> list[Work]:
    """What is left to do for each running request.

    Args:
        rows: that run.
        reading: for each prompt that is not read yet, the rows that wait for it.
        drafts: (request id, draw) of those that are ready; draws whose draft still runs do not wait either.
        pace: what is known of how long responses are.
    """
    found: dict[str, Work] = {}
    drafted = {(row.request.id, draw) for row in rows if row.draft for draw in row.draws} | set(drafts)
    for row in chain(rows, *reading):
        name = row.request.id
        covered = not row.draft and all((name, draw) in drafted for draw in row.draws)
        passes = 0.0 if covered else pace.direct_passes_left(row.passes)
        work = found.get(name) or Work(row.request, 0.0, 0, 0)
        found[name] = work._replace(passes=max(work.passes, passes), rows=work.rows + len(row.draws))
    for waiting in reading:
        name = waiting[0].request.id
        found[name] = found[name]._replace(prompts=found[name].prompts + 1)
    return list(found.values())


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

    order = sorted(
        works,
        key=lambda work: (work.passes == 0, urgency(work.request, now_s + needed_s(work, [work]))),
    )
    if not order:
        return []
    left_s = order[0].request.deadline_s - now_s
    many = len(order)
    if order[0].passes and needed_s(order[0], order[:1]) <= left_s:
        while many > 1 and _SLACK * needed_s(order[0], order[:many]) > left_s:
            many -= 1
    return [work.request for work in order[:many]]
