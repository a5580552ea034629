"""Who comes next: waiting requests, the memory they need, the order they are served in. No torch."""

from __future__ import annotations

from typing import Final

from model.engines.torch.rows import Request

PATIENCE_S: Final = 10.0
"""A request without a deadline waits as if it had this one: those that have some cannot starve it."""


def urgency(request: Request) -> tuple[float, int]:
    """What requests are ordered by: the earliest deadline first, then the earliest arrival."""
    return min(request.deadline_s, request.submitted_s + PATIENCE_S), request.arrival


class Schedule:
    """Requests between arrival and their last draw.

    A request is admitted when as many rows are free as it may ever use, so none runs out of memory on its
    way. It gives way, whole, to one that has a deadline and is more urgent, and comes back in its turn.

    Args:
        rows: draws that can run at once.
    """

    def __init__(self, rows: int) -> None:
        self._rows = rows
        self._waiting: list[Request] = []
        self._admitted: dict[str, Request] = {}

    def __contains__(self, request_id: str) -> bool:
        return request_id in self._admitted or any(each.id == request_id for each in self._waiting)

    @property
    def idle(self) -> bool:
        """Whether nobody waits and nobody runs."""
        return not self._waiting and not self._admitted

    @property
    def free_rows(self) -> int:
        """Rows that no admitted request may claim."""
        return self._rows - sum(map(self.rows_of, self._admitted.values()))

    def rows_of(self, request: Request) -> int:
        """How many rows a request may come to use: every draw one, and one for its draft."""
        return request.controls.n * (2 if request.drafts else 1)

    def fits(self, request: Request) -> bool:
        """Whether a request could run if it were alone."""
        return self.rows_of(request) <= self._rows

    def add(self, request: Request) -> None:
        """Queue a request that `fits`."""
        self._waiting.append(request)

    def make_room(self) -> list[Request]:
        """The running requests, least urgent first, that give way to the most urgent waiting one.

        They wait again. Only a deadline makes others give way, and only those that are less urgent.
        """
        self._waiting.sort(key=urgency)
        if not self._waiting or self._waiting[0].controls.deadline_ms is None:
            return []
        first, victims = self._waiting[0], list[Request]()
        rows = self.free_rows
        for request in sorted(self._admitted.values(), key=urgency, reverse=True):
            if rows >= self.rows_of(first):
                break
            if urgency(request) < urgency(first):
                return []
            victims.append(request)
            rows += self.rows_of(request)
        for request in victims:
            self._waiting.append(self._admitted.pop(request.id))
        return victims

    def admit(self) -> list[Request]:
        """The requests that begin now. Nobody overtakes the most urgent one, however large it is."""
        admitted = []
        self._waiting.sort(key=urgency)
        while self._waiting:
            request = self._waiting[0]
            if self.rows_of(request) > self.free_rows:
                break
            self._admitted[request.id] = self._waiting.pop(0)
            admitted.append(request)
        return admitted

    def release(self, request_id: str) -> None:
        """Forget a request, whether it waits or runs; unknown ids are ignored."""
        self._waiting = [request for request in self._waiting if request.id != request_id]
        self._admitted.pop(request_id, None)
