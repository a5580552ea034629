"""Who is let in: places for draws, reserved before a request costs anything. No I/O."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import AsyncGenerator, Callable, Generator
from contextlib import AbstractContextManager, ExitStack, asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from typing import Final, TypeVar

from looktwice.service.problems import QUEUE_FULL, ProblemError

_Held = TypeVar("_Held")

_MEMORY: Final = 0.1
"""Weight of the latest observation in a running mean."""
_FIRST_DRAW_S: Final = 0.1
"""That a draw keeps its place, before any was seen."""
MAX_WAIT_S: Final = 1.0
"""That a batch's next scene lets others go first."""


class Full(Exception):
    """No place is free.

    Attributes:
        retry_after_s: when one probably will be.
    """

    def __init__(self, detail: str, retry_after_s: float) -> None:
        super().__init__(detail)
        self.retry_after_s = retry_after_s


@dataclass(eq=False)
class Place:
    """What one scene has reserved.

    Attributes:
        draws: how many.
        since_s: when, on the admission's clock.
        waiting: whether the engine has not begun with it.
        waited_s: for its turn, before it was reserved.
    """

    draws: int
    since_s: float = 0.0
    waiting: bool = True
    waited_s: float = 0.0

    def began(self) -> None:
        """The engine has begun with it."""
        self.waiting = False


@dataclass(eq=False)
class _Turn:
    place: Place
    since_s: float
    first_s: float | None = None
    """Since when it is the next one."""
    come: asyncio.Event = field(default_factory=asyncio.Event)


class Admission:
    """Bounds what is accepted and not yet answered.

    Draws are what costs: memory in the engine and time in every pass, so a scene takes as many places as
    it asks draws for. Scenes are bounded too, since each is held with its pictures. Scenes of batches wait
    for places that others leave; one that is next for `MAX_WAIT_S` goes before whoever comes, so that a
    batch gets on under any load.

    Args:
        draws: accepted at once, at most.
        scenes: accepted at once, at most.
        clock: seconds, ever growing.
    """

    def __init__(self, draws: int, scenes: int, clock: Callable[[], float]) -> None:
        self.draws, self.scenes, self._clock = draws, scenes, clock
        self._places: list[Place] = []
        self._turns: deque[_Turn] = deque()
        self._batched = 0
        self._draw_s = _FIRST_DRAW_S

    @property
    def places(self) -> tuple[Place, ...]:
        """All that are taken."""
        return tuple(self._places)

    @property
    def free(self) -> int:
        """Draws that could be accepted beside those that are."""
        return max(0, self.draws - self._held)

    @property
    def _held(self) -> int:
        return sum(place.draws for place in self._places)

    @property
    def waiting(self) -> tuple[Place, ...]:
        """Those that the engine has not begun with, and those that are to come in turn."""
        begun = tuple(place for place in self._places if place.waiting)
        return begun + tuple(turn.place for turn in self._turns)

    def check_open(self, *, batch: bool = False) -> None:
        """Raise `Full` where not even one draw, or scene of a batch, could be accepted."""
        if batch:
            self._check_batch(1)
        else:
            self._check(1)

    @contextmanager
    def place(self, draws: int) -> Generator[Place]:
        """Hold a place for a scene until the block ends.

        Raises:
            Full: it does not fit now.
        """
        self._check(draws)
        place = self._enter(Place(draws))
        try:
            yield place
        finally:
            self._leave(place)

    @contextmanager
    def batch(self, scenes: int) -> Generator[None]:
        """Let a batch in until the block ends; its scenes then take their turns.

        Raises:
            Full: with those of other batches they are too many; alone, a batch is let in however large.
        """
        self._check_batch(scenes)
        self._batched += scenes
        try:
            yield
        finally:
            self._batched -= scenes

    @asynccontextmanager
    async def place_in_turn(self, draws: int) -> AsyncGenerator[Place]:
        """The same as `place`, but wait for it; for scenes of a batch."""
        turn = _Turn(Place(draws), self._clock())
        self._turns.append(turn)
        self._admit_waiting()
        try:
            await turn.come.wait()
            yield turn.place
        finally:
            if turn in self._turns:
                self._turns.remove(turn)
                self._admit_waiting()
            else:
                self._leave(turn.place)

    def _fits(self, draws: int) -> bool:
        # Alone, a scene may be larger than what is accepted beside others.
        return not self._places or (draws <= self.free and len(self._places) < self.scenes)

    def _enter(self, place: Place) -> Place:
        place.since_s = self._clock()
        self._places.append(place)
        return place

    def _leave(self, place: Place) -> None:
        # Places are left at the rate of those held side by side.
        held_s = self._clock() - place.since_s
        self._draw_s += _MEMORY * (held_s / self._held - self._draw_s)
        self._places.remove(place)
        self._admit_waiting()

    def _admit_waiting(self) -> None:
        while self._turns and self._fits(self._turns[0].place.draws):
            turn = self._turns.popleft()
            turn.place.waited_s = self._clock() - turn.since_s
            self._enter(turn.place)
            turn.come.set()
        if self._turns and self._turns[0].first_s is None:
            self._turns[0].first_s = self._clock()

    def _free_is_reserved(self) -> bool:
        """Whether what is free is kept for a batch's next scene."""
        first_s = self._turns[0].first_s if self._turns else None
        return first_s is not None and self._clock() - first_s > MAX_WAIT_S

    def _check_batch(self, scenes: int) -> None:
        if self._batched and self._batched + scenes > self.scenes:
            detail = f"{scenes} scenes of a batch were asked for beside {self._batched} of others"
            waiting_s = sum(turn.place.draws for turn in self._turns) * self._draw_s
            raise Full(f"{detail}; {self.scenes} are accepted at once", waiting_s)

    def _check(self, draws: int) -> None:
        if self._free_is_reserved():
            first = self._turns[0].place.draws
            raise Full("the next scene of a batch has waited and goes first", first * self._draw_s)
        if self._fits(draws):
            return
        missing = max(1, draws - self.free)
        if len(self._places) >= self.scenes:
            detail = f"{len(self._places)} scenes are being planned for, as many as are accepted at once"
        else:
            detail = f"{draws} draws were asked for; of {self.draws} at once {self.free} are free"
        raise Full(detail, missing * self._draw_s)


def whole_seconds(seconds: float) -> int:
    """For ``Retry-After``, which knows no fractions; at least 1."""
    return max(1, math.ceil(seconds))


@contextmanager
def full_as_problem() -> Generator[None]:
    """`Full` in the block as a `ProblemError` that says when to come back."""
    try:
        yield
    except Full as full:
        raise ProblemError(QUEUE_FULL, str(full), retry_after_s=whole_seconds(full.retry_after_s)) from None


@contextmanager
def let_in(place: AbstractContextManager[_Held]) -> Generator[_Held]:
    """Hold what an `Admission` gives until the block ends; raises `ProblemError` where it is full."""
    with ExitStack() as stack:
        with full_as_problem():
            held = stack.enter_context(place)
        yield held
