"""A request in the engine: its phase, its trees of rows, its drafts. No torch.

A request waits, runs, and ends; it may be preempted in between, as often as it has to. Its rows stand in
trees, one for each copy of the prompt, and nowhere else. Whatever ends or interrupts rows is a method here,
so rows and memory are given up together.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import TYPE_CHECKING

from looktwice.model.engines.binding import Binding
from looktwice.model.engines.engine import Controls, Draw, PlanRequest
from looktwice.model.engines.least_error import LeastError
from looktwice.model.engines.reason_mask import ReasonMask
from looktwice.model.engines.torch.kv_memory import Memory
from looktwice.model.engines.torch.rows import Row
from looktwice.model.families.family import Family
from looktwice.model.formats.cursor import Cursor

if TYPE_CHECKING:
    from looktwice.model.engines.torch.runner import PromptPrefill  # a runner needs torch, requests do not

_arrivals = itertools.count()


class Phase(Enum):
    """Where a request stands."""

    WAITING = "waiting"
    """For memory: new, or preempted."""
    RUNNING = "running"
    ENDED = "ended"
    """Answered, cancelled or failed."""


@dataclass(eq=False)
class Tree:
    """Rows that share one copy of a prompt, and the KV row that it lies in.

    Attributes:
        request: whose.
        rows: that have not ended; at least one.
        kv_row: None while the tree has no memory.
        prompt: None until prefill begins.
    """

    request: Request
    rows: list[Row] = field(default_factory=list)
    kv_row: int | None = None
    prompt: PromptPrefill | None = None

    @property
    def decoding(self) -> bool:
        """Whether the prompt is prefilled, so that rows can be fed."""
        return self.prompt is not None and self.prompt.ready

    @property
    def prefilling(self) -> bool:
        """Whether it has memory and prompt tokens to be fed."""
        return self.kv_row is not None and not self.decoding

    def allocate(self, memory: Memory) -> None:
        """Take a KV row, and an entry for each row."""
        self.kv_row = memory.kv_rows.take()
        for row in self.rows:
            row.entry = memory.entries.take()

    def release(self, memory: Memory) -> None:
        """Give up all memory; rows keep what they have written, and will be fed it again."""
        for row in self.rows:
            _give_up_entry(row, memory)
        if self.kv_row is not None:
            memory.kv_rows.give_back(self.kv_row)
        self.kv_row = self.prompt = None

    def start(self) -> None:
        """The prompt is prefilled: rows continue behind it with everything they have written."""
        assert self.prompt is not None
        for row in self.rows:
            row.start(self.prompt.last_token)

    def fork(self, row: Row, draws: tuple[int, ...], memory: Memory, *, draft: bool) -> Row:
        """A row of its own for some of a row's draws, behind the same tokens."""
        assert row.entry is not None
        part = row.part(draws, draft=draft)
        part.entry = memory.fork(row.entry)
        self.rows.append(part)
        return part


@dataclass(eq=False)
class Request:
    """A request, owner of its rows and drafts; times are those of the engine's clock.

    Attributes:
        plan_request: what is asked.
        family: of the response.
        origin: the cursor at which responses begin.
        submitted_s: what its deadline counts from.
        least_error: tells how far apart numbers and codes lie.
        draws_a_tree: how many draws share a copy of the prompt, at most.
        arrival: ascending.
        phase: where it stands.
        trees: of rows that have not ended.
        drafts: by draw, until the draw is answered.
        started: whether it has left the queue once.
        binding: where the caller's control ``bind`` asks for it.
        reason_mask: what its reflections may name, known once its prompt is; None for anything.
        expects: whether something is known of the picture that is asked for.
    """

    plan_request: PlanRequest
    family: Family
    origin: Cursor
    submitted_s: float
    least_error: LeastError
    draws_a_tree: int = 1
    arrival: int = field(default_factory=lambda: next(_arrivals))
    phase: Phase = Phase.WAITING
    trees: list[Tree] = field(default_factory=list)
    drafts: dict[int, Draw] = field(default_factory=dict)
    started: bool = False
    binding: Binding | None = None
    reason_mask: ReasonMask | None = None
    expects: bool = False

    @property
    def id(self) -> str:
        """The caller's name for it."""
        return self.plan_request.request_id

    @property
    def controls(self) -> Controls:
        """What the caller decided."""
        return self.plan_request.controls

    @property
    def deadline_s(self) -> float:
        """When the answer must be there; infinite without a deadline."""
        deadline_ms = self.controls.deadline_ms
        return float("inf") if deadline_ms is None else self.submitted_s + deadline_ms / 1000

    @cached_property
    def makes_drafts(self) -> bool:
        """Whether a direct trajectory is made beside every reflection."""
        reflects = self.family.branch is not None and self.controls.thinking != "never"
        return self.controls.deadline_ms is not None and reflects

    @property
    def most_rows(self) -> int:
        """Rows that it may come to use: one for every draw, and one for its draft."""
        return self.controls.n * (2 if self.makes_drafts else 1)

    @property
    def rows(self) -> Iterator[Row]:
        """All that have not ended, in whatever state."""
        return itertools.chain.from_iterable(tree.rows for tree in self.trees)

    def plant(self, *, share: bool) -> None:
        """Make the first rows: one a tree, or one a draw where rows are not shared."""
        draws = range(self.controls.n)
        for first in draws[:: self.draws_a_tree]:
            tree = Tree(self)
            mine = tuple(draws[first : first + self.draws_a_tree])
            groups = [mine] if share else [(draw,) for draw in mine]
            tree.rows = [Row(self.origin, tree, group) for group in groups]
            self.trees.append(tree)

    def run(self, memory: Memory) -> None:
        """Take memory for every tree that has none; enough of it must be free."""
        self.phase = Phase.RUNNING
        for tree in self.trees:
            if tree.kv_row is None:
                tree.allocate(memory)

    def preempt(self, memory: Memory) -> None:
        """Give up all memory and wait again. What was written is kept, and trees are as few as at first."""
        self._release(memory)
        trees: dict[int, Tree] = {}
        for row in self.rows:
            row.tree = trees.setdefault(row.draws[0] // self.draws_a_tree, Tree(self))
            row.tree.rows.append(row)
        self.trees, self.phase = list(trees.values()), Phase.WAITING

    def split(self, tree: Tree, rows: Sequence[Row], memory: Memory) -> None:
        """Preempt some of a tree's rows: they wait for a KV row as a tree of their own."""
        new = Tree(self, list(rows))
        for row in rows:
            tree.rows.remove(row)
            _give_up_entry(row, memory)
            row.tree = new
        self.trees.append(new)

    def answer(self, draws: Collection[int], memory: Memory) -> None:
        """These draws are answered: forget their drafts, take them out of all rows, end with the last one."""
        for draw in draws:
            self.drafts.pop(draw, None)
        for row in list(self.rows):
            row.draws = tuple(draw for draw in row.draws if draw not in draws)
            if not row.draws:
                self.remove(row, memory)
        if not self.trees:
            self.end(memory)

    def remove(self, row: Row, memory: Memory) -> None:
        """A row is done with; its tree goes with the last one."""
        tree = row.tree
        tree.rows.remove(row)
        _give_up_entry(row, memory)
        if not tree.rows:
            tree.release(memory)
            self.trees.remove(tree)

    def end(self, memory: Memory) -> None:
        """Answered, cancelled or failed: give up everything."""
        self._release(memory)
        self.trees, self.drafts, self.phase = [], {}, Phase.ENDED

    def _release(self, memory: Memory) -> None:
        for tree in self.trees:
            tree.release(memory)


def _give_up_entry(row: Row, memory: Memory) -> None:
    if row.entry is not None:
        memory.entries.give_back(row.entry)
    row.entry = None
