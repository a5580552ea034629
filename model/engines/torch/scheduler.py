"""Who gets memory: the order of requests, who is admitted, who is preempted. No torch.

`Scheduler.schedule` only decides; `Request.run` and `Request.preempt` act on it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, NamedTuple

from looktwice.model.engines.torch.request import Phase, Request, Tree

MAX_WAIT_S: Final = 4.0
"""A request without a deadline waits as if it had this one, so that others cannot starve it."""


def urgency(request: Request, now_s: float) -> tuple[float, int]:
    """What requests are ordered by: the earliest deadline first, then the earliest arrival.

    A request whose deadline has passed counts as one without: served first it would make others late too.
    """
    latest_s = request.submitted_s + MAX_WAIT_S
    due_s = latest_s if request.deadline_s < now_s else min(request.deadline_s, latest_s)
    return due_s, request.arrival


class FreeRows(NamedTuple):
    """Memory to be had: rows of the batch, and KV rows."""

    rows: int
    kv_rows: int

    def within(self, other: FreeRows) -> bool:
        """Whether ``other`` is as much in both."""
        return self.rows <= other.rows and self.kv_rows <= other.kv_rows

    def without(self, other: FreeRows) -> FreeRows:
        """What is left when ``other`` is taken."""
        return FreeRows(self.rows - other.rows, self.kv_rows - other.kv_rows)


class Schedule(NamedTuple):
    """What a step begins with.

    Attributes:
        preempt: requests that give up their memory, first of all.
        admit: requests that begin, or come back.
        grow: trees of running requests that get a KV row of their own.
    """

    preempt: list[Request]
    admit: list[Request]
    grow: list[Tree]


class Scheduler:
    """All requests between arrival and their last draw.

    A request is admitted when there is a row for everything it may come to run, and a KV row for each of its
    trees. A KV row holds what responses usually take. When a tree outgrows it, some of its rows leave as a
    tree of their own (`Request.split`), which waits here for a KV row.

    Args:
        rows: of the batch.
        kv_rows: that trees can have at once.
        rows_a_tree: that share a KV row at first; 1 to give every draw one of its own.
    """

    def __init__(self, rows: int, kv_rows: int, rows_a_tree: int) -> None:
        self._all, self._rows_a_tree = FreeRows(rows, kv_rows), rows_a_tree
        self._requests: dict[str, Request] = {}

    def __contains__(self, request_id: str) -> bool:
        return request_id in self._requests

    @property
    def idle(self) -> bool:
        """Whether nobody waits and nobody runs."""
        return not self._requests

    @property
    def requests(self) -> list[Request]:
        """Those that wait and those that run."""
        return list(self._requests.values())

    def running(self, now_s: float) -> list[Request]:
        """Those that have memory, the most urgent first."""
        found = [request for request in self._requests.values() if request.phase is Phase.RUNNING]
        return sorted(found, key=lambda request: urgency(request, now_s))

    @property
    def rows_used(self) -> int:
        """Rows that are reserved."""
        return self._all.rows - self._free().rows

    def draws_a_tree(self, request: Request) -> int:
        """How many draws share a copy of the prompt, when their drafts are there too."""
        return max(1, self._rows_a_tree // (2 if request.makes_drafts else 1))

    def fits(self, request: Request) -> bool:
        """Whether a new request could run if it were alone."""
        return _needed(request).within(self._all)

    def add(self, request: Request) -> None:
        """Queue a request that `fits`."""
        self._requests[request.id] = request

    def get(self, request_id: str) -> Request | None:
        """A request that has not ended."""
        return self._requests.get(request_id)

    def remove(self, request: Request) -> None:
        """Forget a request that has ended."""
        del self._requests[request.id]

    def schedule(self, now_s: float) -> Schedule:
        """Decide who gives up memory and who gets some. Nobody overtakes the most urgent one that waits."""
        queue = sorted(filter(_waits, self._requests.values()), key=lambda each: urgency(each, now_s))
        if not queue:
            return Schedule([], [], [])
        preempted = self._victims(queue[0], now_s)
        if preempted:
            # Others stand behind those that were just preempted, which join the queue with the next step.
            queue = queue[:1]
        free, admitted, growing = self._free(preempted), list[Request](), list[Tree]()
        for request in queue:
            if request.phase is Phase.WAITING:
                if not (needed := _needed(request)).within(free):
                    break
                free = free.without(needed)
                admitted.append(request)
                continue
            # Its rows are reserved already; one KV row after the other, however many trees wait.
            trees = [tree for tree in request.trees if tree.kv_row is None][: free.kv_rows]
            free = free.without(FreeRows(0, len(trees)))
            growing += trees
            if not free.kv_rows:
                break
        return Schedule(preempted, admitted, growing)

    def _victims(self, first: Request, now_s: float) -> list[Request]:
        """The running requests, least urgent first, that are preempted for the most urgent waiting one.

        Only a deadline preempts others, and only those that are less urgent.
        """
        if not now_s <= first.deadline_s < float("inf"):
            return []
        needed = _needed(first) if first.phase is Phase.WAITING else FreeRows(0, 1)
        victims, running = list[Request](), [each for each in self.running(now_s) if each is not first]
        while running and not needed.within(self._free(victims)):
            if urgency(running[-1], now_s) < urgency(first, now_s):
                return []
            victims.append(running.pop())
        return victims

    def _free(self, preempted: Iterable[Request] = ()) -> FreeRows:
        """What is not reserved, once some requests are preempted."""
        free = self._all
        for request in self._requests.values():
            if request.phase is Phase.RUNNING and request not in preempted:
                free = free.without(FreeRows(request.most_rows, _kv_rows(request)))
        return free


def _waits(request: Request) -> bool:
    """For memory."""
    return request.phase is Phase.WAITING or any(tree.kv_row is None for tree in request.trees)


def _needed(request: Request) -> FreeRows:
    """What a request begins with."""
    return FreeRows(request.most_rows, len(request.trees))


def _kv_rows(request: Request) -> int:
    return sum(tree.kv_row is not None for tree in request.trees)
