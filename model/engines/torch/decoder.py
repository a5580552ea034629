"""The decoding loop without threads. A step: schedule, run, apply."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.model.engines.binding import Binding, binding_of
from looktwice.model.engines.engine import (
    DraftFinished,
    Draw,
    DrawFinished,
    EngineError,
    Event,
    PlanRequest,
    RequestError,
    Started,
)
from looktwice.model.engines.engine_requests import read, start_cursor
from looktwice.model.engines.least_error import LeastError
from looktwice.model.engines.logprobs import reported
from looktwice.model.engines.reason_mask import reason_mask_of
from looktwice.model.engines.torch.batch import Batch, Feed
from looktwice.model.engines.torch.deadlines import LatencyModel, drafts_of
from looktwice.model.engines.torch.drafter import Drafter
from looktwice.model.engines.torch.request import Phase, Request, Tree
from looktwice.model.engines.torch.rows import Row
from looktwice.model.engines.torch.runner import ROWS_A_TREE, PromptRequest, Runner
from looktwice.model.engines.torch.scheduler import Scheduler
from looktwice.model.engines.torch.shortcuts import Shortcuts

Logits = npt.NDArray[np.float64]

_ALONE: Final = 4
"""So many times the prefill chunk goes through in a step while no row waits for it."""


@dataclass(frozen=True)
class Failed:
    """A request ended without all its draws."""

    error: Exception


StepEvent = tuple[str, Event | Failed]
"""A request id and what happened to it."""


@dataclass
class Counts:
    """What the decoder has done so far.

    Attributes:
        passes: through the network, for draws.
        row_passes: rows fed, over all passes.
        fan_out_row_passes: the same if every draw had a row of its own.
        scene_passes: scenes whose draws were fed, over all passes.
        tokens: fed, over all rows.
        kept: of these, what rows went on with; the others were rejected guesses.
        preempted: rows that gave up their memory and were fed again later.
    """

    passes: int = 0
    row_passes: int = 0
    fan_out_row_passes: int = 0
    scene_passes: int = 0
    tokens: int = 0
    kept: int = 0
    preempted: int = 0


class Decoder:
    """Continuous batching: requests, and rows of a request, join and leave at every step.

    Args:
        runner: network and memory; the decoder's alone.
        shortcuts: see there.
        prompt_chunk: prompt tokens that are prefilled in one step while rows run.
        clock: seconds, ever growing; what deadlines count on.
        latency: what is known of how long things take.
    """

    def __init__(
        self,
        runner: Runner,
        shortcuts: Shortcuts = Shortcuts(),
        *,
        prompt_chunk: int = 512,
        clock: Callable[[], float] = time.monotonic,
        latency: LatencyModel | None = None,
    ) -> None:
        self._runner, self._shortcuts, self._chunk = runner, shortcuts, prompt_chunk
        self._clock, self._latency, self._drafter = clock, latency or LatencyModel(), Drafter()
        rows_a_tree = ROWS_A_TREE if shortcuts.shared_prompts else 1
        self._scheduler, self._memory = Scheduler(runner.rows, runner.prompts, rows_a_tree), runner.memory()
        self._vocabulary = runner.loaded.vocabulary
        self._least_error = LeastError(runner.loaded.codec, self._vocabulary)
        self.counts = Counts()

    @property
    def rows_used(self) -> int:
        """Draws that memory is reserved for."""
        return self._scheduler.rows_used

    @property
    def idle(self) -> bool:
        """Whether there is nothing to do."""
        return self._scheduler.idle

    def add(
        self,
        plan_request: PlanRequest,
        submitted_s: float | None = None,
        binding: Binding | None = None,
    ) -> None:
        """Queue a request.

        Args:
            plan_request: what is asked.
            submitted_s: when, on the decoder's clock, its deadline counts from; now if it is not given.
            binding: of the request, see `binding_of`; made here if it is not given.

        Raises:
            RequestError: it can never be served: unknown format, too many draws, a missing camera, a
                prefill the format cannot write; or its id is in use.
        """
        if plan_request.request_id in self._scheduler:
            raise RequestError(f"request id {plan_request.request_id} is in use")
        loaded = self._runner.loaded
        expected = loaded.inputs.expected(plan_request.scene, plan_request.controls.view)
        origin = start_cursor(
            plan_request, loaded.card, self._runner.families, self._runner.formats, expected
        )
        arrived_s = self._clock() if submitted_s is None else submitted_s
        family = self._runner.families[plan_request.format]
        request = Request(plan_request, family, origin, arrived_s, self._least_error)
        request.expects = expected is not None
        request.binding = binding or binding_of(plan_request, loaded.codec, loaded.vocabulary)
        request.draws_a_tree = self._scheduler.draws_a_tree(request)
        request.plant(share=self._shortcuts.shared_rows)
        if not self._scheduler.fits(request):
            raise RequestError(
                f"n is {request.controls.n}; this engine runs at most {self._runner.rows} draws at once"
                + (", half of them under a deadline" if request.makes_drafts else "")
            )
        self._scheduler.add(request)

    def cancel(self, request_id: str) -> None:
        """Drop a request, whether it waits or runs; its memory is free at once. Unknown ids are ignored."""
        if request := self._scheduler.get(request_id):
            self._end(request)

    def renew(self) -> None:
        """Go on with the network's weights as they are now, see `Runner.renew`.

        What steps take follows from the sizes of the network, so the latency model stays.

        Raises:
            EngineError: there are requests, which other weights have begun.
        """
        if not self.idle:
            raise EngineError("weights can only change while there are no requests")
        self._runner.renew()
        self._drafter = Drafter()

    def step(self) -> list[StepEvent]:
        """Schedule, run, apply; returns what happened."""
        began_s = self._clock()
        events = self._schedule(began_s)
        events += self._prefill(began_s)
        fed, failures = self._feeds()
        events += failures
        if fed:
            logits = self._runner.feed(Batch.of([feed for _, feed in fed], self._memory))
            events += self._apply(fed, logits)
            self._latency.saw_step(self._clock() - began_s)
        return events + self._settle_for_drafts()

    # Schedule: who has memory, what is fed.

    def _schedule(self, now_s: float) -> list[StepEvent]:
        """Preempt who has to give way, and give memory to who comes next."""
        schedule = self._scheduler.schedule(now_s)
        for request in schedule.preempt:
            self._preempt(request)
        events: list[StepEvent] = []
        for request in schedule.admit:
            if not request.started:
                events.append((request.id, Started()))
            request.started = True
            request.run(self._memory)
        for tree in schedule.grow:
            tree.allocate(self._memory)
        return events

    def _preempt(self, request: Request) -> None:
        self.counts.preempted += len(list(request.rows))
        request.preempt(self._memory)

    def _feeds(self) -> tuple[list[tuple[Row, Feed]], list[StepEvent]]:
        """What each row feeds whose prompt is prefilled, and the failures of those that cannot go on."""
        trees = self._decoding()
        rows = sum(len(tree.rows) for tree in trees)
        fed: list[tuple[Row, Feed]] = []
        failures: list[StepEvent] = []
        for tree in trees:
            if tree.request.phase is Phase.ENDED:
                continue  # it failed with another of its trees
            try:
                feeds = self._feeds_of(tree, rows)
            except Exception as error:  # one draw that cannot go on must not end the others
                failure = EngineError.because("a draw could not go on", error)
                failures.append(self._fail(tree.request, failure))
                continue
            fed += zip(tree.rows, feeds, strict=True)
        # A request that failed may have another tree before the one it failed with.
        return [each for each in fed if each[0].request.phase is Phase.RUNNING], failures

    def _decoding(self) -> list[Tree]:
        return [tree for request in self._scheduler.requests for tree in request.trees if tree.decoding]

    def _feeds_of(self, tree: Tree, rows: int) -> list[Feed]:
        """What the rows of a tree feed; those for which its KV row has no slots leave it.

        Args:
            tree: whose prompt is prefilled.
            rows: in the pass.
        """
        feeds = [self._feed_of(row, rows if self._shortcuts.speculate else 0) for row in tree.rows]
        if self._memory.fitting([feed.row_input for feed in feeds]) == len(feeds):
            return feeds
        # Guesses are given up first, then rows, the drafts last: these are what a deadline can rely on.
        tree.rows.sort(key=lambda row: not row.draft)
        feeds = [self._feed_of(row, 0) for row in tree.rows]
        fitting = self._memory.fitting([feed.row_input for feed in feeds])
        if leaving := tree.rows[fitting:]:
            self.counts.preempted += len(leaving)
            tree.request.split(tree, leaving, self._memory)
        return feeds[:fitting]

    def _feed_of(self, row: Row, rows: int) -> Feed:
        """A row's pending tokens and guesses behind them, with the decisions among both.

        Args:
            row: to be fed.
            rows: in the pass; 0 to guess nothing.
        """
        prompt = row.tree.prompt
        assert row.entry is not None
        assert prompt is not None
        if not self._shortcuts.jump and len(row.pending) > 1:
            return Feed(row.entry, prompt, row.held, row.pending[:1], ())
        tokens, wanted = self._drafter.propose(row, rows)
        return Feed(row.entry, prompt, row.held, tokens, wanted)

    # Run: the network.

    def _prefill(self, now_s: float) -> list[StepEvent]:
        """Some prompt tokens, the most urgent request's first; many while no row waits for the pass."""
        left = self._chunk if self._decoding() else _ALONE * self._chunk
        chunks: list[tuple[Tree, int]] = []
        for request in self._scheduler.running(now_s):
            for tree in filter(lambda tree: tree.prefilling, request.trees):
                if left <= 0:
                    break
                count = min(left, self._runner.prompt_tokens)
                chunks.append((tree, count))
                left -= count
        events = self._open([tree for tree, _ in chunks if tree.prompt is None])
        # Those that failed have no prompt.
        parts = [(tree.prompt, count) for tree, count in chunks if tree.prompt is not None]
        if parts:
            self._runner.feed_prompts(parts)
        for tree in [tree for tree, _ in chunks if tree.decoding]:
            tree.start()
            for row in tree.rows:
                if not row.tokens:
                    events += [(tree.request.id, event) for event in row.write(None, self._vocabulary)]
        return events

    def _open(self, trees: Sequence[Tree]) -> list[StepEvent]:
        """Begin to prefill, pictures encoded together; requests whose scene cannot be read fail."""
        scenes = []
        for tree in trees:
            assert tree.kv_row is not None
            asked = tree.request.plan_request
            view = asked.controls.view
            scenes.append(PromptRequest(asked.scene, asked.format, tree.kv_row, asked.attempt, view))
        events: list[StepEvent] = []
        for tree, begun in zip(trees, self._runner.begin_prompts(scenes), strict=True):
            if tree.request.phase is Phase.ENDED:
                continue
            if not isinstance(begun, Exception):
                tree.prompt, request = begun, tree.request
                request.reason_mask = reason_mask_of(
                    request.plan_request, request.family, self._vocabulary, begun.facts
                )
            elif isinstance(begun, ValueError):
                events.append(self._fail(tree.request, RequestError(str(begun))))
            else:
                failure = EngineError.because("the scene could not be encoded", begun)
                events.append(self._fail(tree.request, failure))
        return events

    # Apply: what was chosen.

    def _apply(self, fed: Sequence[tuple[Row, Feed]], logits: Sequence[list[Logits]]) -> list[StepEvent]:
        """Write what rows choose, and end those that are done."""
        self._count(fed)
        events: list[StepEvent] = []
        for (row, feed), found in zip(fed, logits, strict=True):
            events += self._guarded(
                row, "a draw could not go on", partial(self._accept, feed=feed, found=found)
            )
        for row in [row for tree in self._decoding() for row in tree.rows if row.cursor.done]:
            events += self._guarded(row, "a response could not be read back", self._finish)
        return events

    def _guarded(self, row: Row, what: str, act: Callable[[Row], list[Event]]) -> list[StepEvent]:
        """What ``act`` gives for a row; where it goes wrong the row's request fails, and no other.

        Rows that ended meanwhile, with their request or with their draws, are left alone.
        """
        request = row.request
        if request.phase is Phase.ENDED or not row.draws:
            return []
        try:
            return [(request.id, event) for event in act(row)]
        except Exception as error:
            return [self._fail(request, EngineError.because(what, error))]

    def _accept(self, row: Row, feed: Feed, found: Sequence[Logits]) -> list[Event]:
        """Choose at one decision of a feed after the other, while what was fed is what is chosen."""
        if not all(np.isfinite(values).all() for values in found):
            self._wipe(row.request)
            raise ValueError("the network gave logits that are no numbers")
        events: list[Event] = []
        row.passes += 1
        held = row.held
        first = len(row.tokens) - len(row.pending)
        guessed = feed.tokens[len(row.pending) :]
        row.fed(min(len(row.pending), len(feed.tokens)))
        for place, logits in enumerate(found, 1):
            events += self._choose(row, logits, guessed[0] if guessed else None)
            agreed = 0
            while agreed < min(len(row.pending), len(guessed)) and row.pending[agreed] == guessed[agreed]:
                agreed += 1
            row.fed(agreed)
            guessed = guessed[agreed:]
            if row.pending:
                later = [first + position + 1 for position, _ in feed.wanted[place:]]
                self._drafter.look_again(row, later, found[place:])
                break
        self.counts.kept += row.held - held
        return events

    def _choose(self, row: Row, logits: Logits, guess: int | None) -> list[Event]:
        """Write what the row's draws choose; those that choose otherwise get rows of their own.

        The row goes on with those that choose ``guess``, if any do.
        """
        time_for = self._latency.time_for(row.request.deadline_s, self._clock(), picture=row.may_imagine)
        chosen = sorted(row.choices(logits, time_for), key=lambda choice: choice[0] != guess)
        self._drafter.observe(row, len(logits), chosen)
        branch = row.request.family.branch if row.request.makes_drafts else None
        drafts = [] if branch is None else drafts_of(branch, row.cursor, chosen)
        parts = [
            (row.tree.fork(row, draws, self._memory, draft=draft), token)
            for some, draft in ((chosen[1:], False), (drafts, True))
            for token, draws in some
        ]
        token, row.draws = chosen[0]
        events = list[Event]()
        for writing, written in ((row, token), *parts):
            logprob = reported(row.request.controls, writing.cursor, logits, written)
            events += writing.write(written, self._vocabulary, logprob)
        return events

    def _finish(self, row: Row) -> list[Event]:
        """Take a row out that is done, and read its response."""
        request, loaded = row.request, self._runner.loaded
        draws = read(
            request.plan_request,
            request.family,
            row,
            row.passes,
            row.draws,
            loaded.vocabulary,
            loaded.codec,
            request.reason_mask,
        )
        if row.passes_before_ending:
            self._latency.saw_ending(row.passes - row.passes_before_ending)
        if row.passes_before_picture:
            self._latency.saw_picture(row.passes - row.passes_before_picture)
        if row.draft:
            request.drafts |= {draw.index: draw for draw in draws}
            request.remove(row, self._memory)
            return [DraftFinished(draw) for draw in draws]
        self._drafter.finished(row)
        return self._answer(request, draws)

    def _answer(self, request: Request, draws: Sequence[Draw]) -> list[Event]:
        """Finished draws; the request ends with its last one."""
        request.answer([draw.index for draw in draws], self._memory)
        if request.phase is Phase.ENDED:
            self._scheduler.remove(request)
        return [DrawFinished(draw) for draw in draws]

    def _settle_for_drafts(self) -> list[StepEvent]:
        """Answer with drafts where the reflection will not end in time, of preempted requests too."""
        events: list[StepEvent] = []
        now_s = self._clock()
        for request in self._scheduler.requests:
            if request.drafts and self._latency.last_step(request.deadline_s, now_s):
                drafts = [replace(draft, cut="replaced") for draft in request.drafts.values()]
                events += [(request.id, event) for event in self._answer(request, drafts)]
        return events

    def _fail(self, request: Request, error: Exception) -> StepEvent:
        self._end(request)
        return request.id, Failed(error)

    def _end(self, request: Request) -> None:
        request.end(self._memory)
        self._scheduler.remove(request)

    def _wipe(self, request: Request) -> None:
        """Let nobody read what a request has written."""
        for tree in request.trees:
            if tree.kv_row is not None:
                self._runner.wipe(tree.kv_row)

    def _count(self, fed: Sequence[tuple[Row, Feed]]) -> None:
        counts = self.counts
        counts.passes += 1
        counts.row_passes += len(fed)
        counts.fan_out_row_passes += sum(len(row.draws) for row, _ in fed)
        counts.scene_passes += len({id(row.tree) for row, _ in fed})
        counts.tokens += sum(len(feed.tokens) for _, feed in fed)
