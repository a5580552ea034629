from __future__ import annotations

from typing import Any

from looktwice.model.engines.engine import Controls, PlanRequest
from looktwice.model.engines.torch.kv_memory import Memory
from looktwice.model.engines.torch.request import Phase, Request
from looktwice.model.engines.torch.scheduler import Scheduler
from looktwice.model.families.cf_vla import CF_VLA
from tests.checkpoints import noisy_scene

SCENE = noisy_scene(0)


class Queue:
    """A scheduler and a memory of eight rows and four KV rows, as a decoder uses both."""

    def __init__(self) -> None:
        self.scheduler = Scheduler(8, 4, 2)
        self.memory = Memory(rows=8, row_tokens=10, kv_rows=4, kv_length=20)

    def add(self, name: str, n: int = 2, deadline_ms: int | None = None) -> Request:
        asked = PlanRequest(name, SCENE, "cf_vla", Controls(n=n, deadline_ms=deadline_ms, thinking="never"))
        unused: Any = None  # where responses begin and how numbers are chosen is of no account here
        request = Request(asked, CF_VLA, unused, 0.0, unused, draws_a_tree=2)
        request.__dict__["makes_drafts"] = False
        request.plant(share=True)
        self.scheduler.add(request)
        return request

    def schedule(self, now_s: float = 0.0) -> tuple[str, str, int]:
        """Act on a schedule; names of who was preempted and admitted, and how many trees grew."""
        preempt, admit, grow = self.scheduler.schedule(now_s)
        for request in preempt:
            request.preempt(self.memory)
        for request in admit:
            request.run(self.memory)
        for tree in grow:
            tree.allocate(self.memory)
        return "".join(each.id for each in preempt), "".join(each.id for each in admit), len(grow)

    def end(self, request: Request) -> None:
        request.end(self.memory)
        self.scheduler.remove(request)


def test_requests_are_admitted_in_order_while_there_is_room() -> None:
    queue = Queue()
    first, _, _ = queue.add("a", 4), queue.add("b", 6), queue.add("c", 2)
    assert queue.schedule() == ("", "a", 0)
    assert queue.schedule() == ("", "", 0), "nobody overtakes the most urgent one, however large it is"
    queue.end(first)
    assert queue.schedule() == ("", "bc", 0)


def test_the_earliest_deadline_comes_first() -> None:
    queue = Queue()
    queue.add("a"), queue.add("b", deadline_ms=2_000), queue.add("c", deadline_ms=1_000)
    queue.add("d", deadline_ms=9_000)
    assert queue.schedule() == ("", "cbad", 0)


def test_a_deadline_that_has_passed_counts_no_more() -> None:
    queue = Queue()
    queue.add("a", 8), queue.add("b", 8, deadline_ms=1_000), queue.add("c", 8, deadline_ms=3_000)
    assert queue.schedule(now_s=2.0) == ("", "c", 0)


def test_a_deadline_preempts_those_that_are_less_urgent() -> None:
    queue = Queue()
    queue.add("a", 4), queue.add("b", 4)
    assert queue.schedule() == ("", "ab", 0)
    queue.add("c", 4)
    assert queue.schedule() == ("", "", 0), "it has no deadline"
    urgent = queue.add("d", 2, deadline_ms=1_000)
    assert queue.schedule() == ("b", "d", 0)
    queue.add("e", 8, deadline_ms=2_000)
    assert queue.schedule() == ("", "", 0), "those that are more urgent are not enough"
    queue.end(urgent)
    assert queue.schedule() == ("a", "e", 0)


def test_trees_that_left_a_kv_row_get_one_after_the_other() -> None:
    queue = Queue()
    running, other = queue.add("a", 4), queue.add("b", 4)
    assert queue.schedule() == ("", "ab", 0)
    for tree in list(running.trees):
        tree.fork(tree.rows[0], tree.rows[0].draws[1:], queue.memory, draft=False)
        running.split(tree, tree.rows[1:], queue.memory)
    assert queue.schedule() == ("", "", 0)
    queue.add("c", 2)
    other.remove(next(other.rows), queue.memory)
    assert queue.schedule() == ("", "", 1)
    queue.end(other)
    assert queue.schedule() == ("", "", 1)
    assert running.phase is Phase.RUNNING
    queue.end(running)
    assert queue.schedule() == ("", "c", 0)


def test_a_preempted_request_comes_back_with_as_many_trees_as_it_had() -> None:
    queue = Queue()
    running = queue.add("a", 4)
    queue.schedule()
    tree = running.trees[0]
    tree.fork(tree.rows[0], (1,), queue.memory, draft=False)
    running.split(tree, tree.rows[1:], queue.memory)
    assert len(running.trees) == 3
    running.preempt(queue.memory)
    assert [len(tree.rows) for tree in running.trees] == [2, 1]
    assert (queue.memory.kv_rows.free, queue.memory.entries.free) == (4, 8)
    assert queue.schedule() == ("", "a", 0)
