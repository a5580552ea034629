"""Who comes next: waiting requests, the memory they need, the order they are served in. No torch."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, NamedTuple

from model.engines.torch.rows import Request

PATIENCE_S: Final = 4.0
"""A request without a deadline waits as if it had this one: those that have some cannot starve it."""


def urgency(request: Request, now_s: float) -> tuple[float, int]:
    """What requests are ordered by: the earliest deadline first, then the earliest arrival.

    A request whose deadline has passed counts as one without: served first it would make others late too.
    """
    patience_s = request.submitted_s + PATIENCE_S
    return (
        patience_s if request.deadline_s < now_s else min(request.deadline_s, patience_s)
    ), request.arrival


class Memory(NamedTuple):
    """What requests run in: rows of draws, and prompts."""

    rows: int
    prompts: int

    def within(self, other: Memory) -> bool:
        """Whether ``other`` is as much in both."""
        return self.rows <= other.rows and self.prompts <= other.prompts


class Schedule:
    """Requests between arrival and their last draw.

    A request is admitted when as much memory is free as it may ever use, so none runs out of it on its way.
    It gives way, whole, to one that has a deadline and is more urgent, and comes back in its turn.

    Args:
        rows: draws that can run at once.
        prompts: that can be held at once.
        rows_a_prompt: that one prompt has room for; 1 to give every draw a prompt of its own.
    """

    def __init__(self, rows: int, prompts: int, rows_a_prompt: int) -> None:
        self._rows, self._prompts, self._rows_a_prompt = rows, prompts, rows_a_prompt
        self._waiting: list[Request] = []
        self._admitted: dict[str, Request] = {}

    def __contains__(self, request_id: str) -> bool:
        return request_id in self._admitted or any(each.id == request_id for each in self._waiting)

    @property
    def idle(self) -> bool:
        """Whether nobody waits and nobody runs."""
        return not self._waiting and not self._admitted

    @property
    def free(self) -> Memory:
        """What no admitted request may claim."""
        return self._left(self._admitted.values())

    def reserved(self) -> dict[str, Memory]:
        """What each running request may claim, by its id."""
        return {name: self.memory_of(request) for name, request in self._admitted.items()}

    def memory_of(self, request: Request) -> Memory:
        """What a request may come to use: a row for every draw, and one for its draft."""
        rows_a_draw = 2 if request.drafts else 1
        return Memory(
            request.controls.n * rows_a_draw, -(-request.controls.n // self.draws_a_prompt(request))
        )

    def draws_a_prompt(self, request: Request) -> int:
        """How many draws of a request share a prompt."""
        return max(1, self._rows_a_prompt // (2 if request.drafts else 1))

    def fits(self, request: Request) -> bool:
        """Whether a request could run if it were alone."""
        return self.memory_of(request).within(Memory(self._rows, self._prompts))

    def _left(self, running: Iterable[Request]) -> Memory:
        taken = [self.memory_of(request) for request in running]
        rows, prompts = sum(each.rows for each in taken), sum(each.prompts for each in taken)
        return Memory(self._rows - rows, self._prompts - prompts)

    def add(self, request: Request) -> None:
        """Queue a request that `fits`."""
        self._waiting.append(request)

    def make_room(self, now_s: float) -> list[Request]:
        """The running requests, least urgent first, that give way to the most urgent waiting one.

        They wait again. Only a deadline makes others give way, and only those that are less urgent.
        """
        self._sort(now_s)
        if not self._waiting or not now_s <= self._waiting[0].deadline_s < float("inf"):
            return []
        first, victims = self._waiting[0], list[Request]()
        running = sorted(self._admitted.values(), key=lambda request: urgency(request, now_s))
        while running and not self.memory_of(first).within(self._left(running)):
            if urgency(running[-1], now_s) < urgency(first, now_s):
                return []
            victims.append(running.pop())
        for request in victims:
            self._waiting.append(self._admitted.pop(request.id))
        return victims

    def admit(self, now_s: float) -> list[Request]:
        """The requests that begin now. Nobody overtakes the most urgent one, however large it is."""
        admitted = []
        self._sort(now_s)
        while self._waiting:
            request = self._waiting[0]
            if not self.memory_of(request).within(self.free):
                break
            self._admitted[request.id] = self._waiting.pop(0)
            admitted.append(request)
        return admitted

    def _sort(self, now_s: float) -> None:
        self._waiting.sort(key=lambda request: urgency(request, now_s))

    def release(self, request_id: str) -> None:
        """Forget a request, whether it waits or runs; unknown ids are ignored."""
        self._waiting = [request for request in self._waiting if request.id != request_id]
        self._admitted.pop(request_id, None)
