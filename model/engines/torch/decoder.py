"""The decoding loop without threads: schedule, run one pass, apply what was chosen."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Final

import numpy as np
import numpy.typing as npt

from model.engines.binding import Binding, binding_of
from model.engines.engine import (
    DraftFinished,
    Draw,
    DrawFinished,
    EngineError,
    Event,
    PlanRequest,
    RequestError,
    Started,
)
from model.engines.requests import begin, branch_of, read
from model.engines.torch.ahead import Ahead
from model.engines.torch.pace import Pace
from model.engines.torch.rows import Request, Row
from model.engines.torch.runner import ROWS_A_PROMPT, Feed, Prompt, Runner
from model.engines.torch.schedule import Memory, Schedule
from model.engines.torch.shortcuts import Shortcuts
from model.engines.torch.turns import turn, works
from model.formats.pieces import ACTION, BRANCH, THINKING

Logits = npt.NDArray[np.float64]

_ALONE: Final = 4
"""So many times as many tokens of prompts go through in a step while no draw waits for it."""


@dataclass(frozen=True)
class Failed:
    """A request ended without all its draws."""

    error: Exception


StepEvent = tuple[str, Event | Failed]
"""A request id and what happened to it."""


@dataclass(eq=False)
class _Beginning:
    """Rows that wait for their prompt; it is begun when its turn comes."""

    request: Request
    rows: list[Row]
    prompt: Prompt | None = None


@dataclass
class Counts:
    """What the decoder has done so far.

    Attributes:
        passes: through the network, for draws.
        row_passes: rows fed, over all passes.
        fan_out_row_passes: the same if every draw had a row of its own.
        scene_passes: scenes whose draws were fed, over all passes.
        tokens: fed, over all rows.
        kept: of these, what rows went on with; the others were guessed wrong.
    """

    passes: int = 0
    row_passes: int = 0
    fan_out_row_passes: int = 0
    scene_passes: int = 0
    tokens: int = 0
    kept: int = 0


class Decoder:
    """Continuous batching: requests, and rows of a request, join and leave at every step.

    Args:
        runner: network and memory; the decoder's alone.
        shortcuts: see there.
        prompt_chunk: tokens of new prompts that go through the network in one step while draws run.
        clock: seconds, ever growing; what deadlines count on.
        pace: what is known of how long things take.
    """

    def __init__(
        self,
        runner: Runner,
        shortcuts: Shortcuts = Shortcuts(),
        *,
        prompt_chunk: int = 512,
        clock: Callable[[], float] = time.monotonic,
        pace: Pace | None = None,
    ) -> None:
        self._clock, self._pace = clock, pace or Pace()
        self._drafts: dict[tuple[str, int], Draw] = {}
        self._paused: dict[str, list[Row]] = {}
        self._runner, self._shortcuts, self._chunk = runner, shortcuts, prompt_chunk
        rows_a_prompt = ROWS_A_PROMPT if shortcuts.shared_prompts else 1
        self._schedule = Schedule(runner.rows, runner.prompts, rows_a_prompt)
        self._ahead = Ahead()
        self._beginnings: list[_Beginning] = []
        self._prompts: list[Prompt] = []
        self._rows: list[Row] = []
        self.counts = Counts()

    @property
    def rows_used(self) -> int:
        """Draws that memory is reserved for."""
        return self._runner.rows - self._schedule.free.rows

    @property
    def idle(self) -> bool:
        """Whether there is nothing to do."""
        return self._schedule.idle

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
        if plan_request.request_id in self._schedule:
            raise RequestError(f"request id {plan_request.request_id} is in use")
        start = begin(plan_request, self._runner.loaded.card, self._runner.formats)
        loaded = self._runner.loaded
        request = Request(plan_request, start, self._clock() if submitted_s is None else submitted_s)
        request.binding = binding or binding_of(plan_request, loaded.codec, loaded.vocabulary)
        if not self._schedule.fits(request):
            raise RequestError(
                f"n is {request.controls.n}; this engine runs at most {self._runner.rows} draws at once"
                + (", half of them under a deadline" if request.drafts else "")
            )
        self._schedule.add(request)

    def cancel(self, request_id: str) -> None:
        """Drop a request, whether it waits or runs; its memory is free at once."""
        self._schedule.release(request_id)
        self._paused.pop(request_id, None)
        self._drop_rows(request_id)
        self._drafts = {key: draw for key, draw in self._drafts.items() if key[0] != request_id}

    def _drop_rows(self, request_id: str) -> None:
        for beginning in [each for each in self._beginnings if each.request.id == request_id]:
            self._drop_beginning(beginning)
        for row in [row for row in self._rows if row.request.id == request_id]:
            self._free_row(row)

    def _drop_beginning(self, beginning: _Beginning) -> None:
        self._beginnings.remove(beginning)
        if beginning.prompt is not None:
            self._free_prompt(beginning.prompt)

    def _pause(self, request: Request) -> None:
        """Give up a request's memory and keep what its draws have written."""
        rows = [row for row in self._rows if row.request is request]
        rows += [row for each in self._beginnings if each.request is request for row in each.rows]
        self._drop_rows(request.id)
        self._paused[request.id] = rows

    def step(self) -> list[StepEvent]:
        """Admit what fits, bring prompts on, feed all rows once, and return what happened."""
        began_s = self._clock()
        for request in self._schedule.make_room(began_s):
            self._pause(request)
        events: list[StepEvent] = []
        for request in self._schedule.admit(began_s):
            rows = self._paused.pop(request.id, None)
            if rows is None:
                rows = self._first_rows(request)
                events.append((request.id, Started()))
            groups: dict[int, list[Row]] = {}
            for row in rows:
                groups.setdefault(row.draws[0] // self._schedule.draws_a_prompt(request), []).append(row)
            self._beginnings += [_Beginning(request, group) for group in groups.values()]
        reading = [each.rows for each in self._beginnings]
        going_on = turn(works(self._rows, reading, self._drafts.keys(), self._pace), self._pace, began_s)
        events += self._bring_prompts_on(going_on)
        if any(row.request in going_on for row in self._rows):
            events += self._feed_rows(going_on)
            self._pace.saw_step(self._clock() - began_s)
        return events + self._settle_for_drafts()

    def _feed_rows(self, going_on: Sequence[Request]) -> list[StepEvent]:
        """Feed the rows of those that go on once, and write what was chosen."""
        events: list[StepEvent] = []
        places = [place for place, row in enumerate(self._rows) if row.request in going_on]
        rows = [self._rows[place] for place in places]
        feeds: list[Feed] = []
        for row, place in zip(rows, places, strict=True):
            try:
                feeds.append(self._feed_of(row, place, len(rows)))
            except Exception as error:  # one draw that cannot go on must not end the others
                failure = EngineError.because("a draw could not go on", error)
                # Its rows are gone and others are in their places: begin anew.
                return [self._fail(row.request, failure), *self._feed_rows(going_on)]
        if not feeds:
            return []
        self._count(rows, feeds)
        began_s = self._clock()
        found = self._runner.feed(feeds)
        self._pace.saw_pass(self._clock() - began_s, len(rows))
        for row, feed, logits in zip(rows, feeds, found, strict=True):
            if row not in self._rows:
                continue  # its request failed with another of its rows
            if not all(np.isfinite(values).all() for values in logits):
                events.append(self._fail_without_numbers(row.request))
                continue
            try:
                events += self._apply(row, feed, logits)
            except Exception as error:  # one draw that cannot go on must not end the others
                failure = EngineError.because("a draw could not go on", error)
                events.append(self._fail(row.request, failure))
        return events + self._end_the_done()

    def check_integrity(self) -> None:
        """Raise `AssertionError` when the books do not agree with each other."""
        assert [prompt.row for prompt in self._prompts] == list(range(len(self._prompts)))
        held = {id(prompt) for prompt in self._prompts}
        begun = [each.prompt for each in self._beginnings if each.prompt is not None]
        used = {id(row.prompt) for row in self._rows} | {id(prompt) for prompt in begun}
        assert held == used, "a prompt is held for nobody, or missing"
        draws = [(row.request.id, draw, row.draft) for row in self._every_row() for draw in row.draws]
        assert len(draws) == len(set(draws)), "a draw runs twice"
        reserved = self._schedule.reserved()
        claimed = [(row.request.id, row.prompt) for row in self._rows]
        claimed += [(each.request.id, each.prompt) for each in self._beginnings for _ in each.rows]
        rows = Counter(name for name, _ in claimed)
        prompts = Counter(name for name, _ in {(name, id(prompt)) for name, prompt in claimed if prompt})
        assert rows.keys() == reserved.keys(), "memory is reserved for nobody, or somebody runs without"
        for name, memory in reserved.items():
            assert Memory(rows[name], prompts[name]).within(memory), "a request uses more than it reserved"
        assert prompts.total() == len(self._prompts), "requests share a prompt's memory"
        assert all(name in self._schedule and name not in reserved for name in self._paused)
        assert all(name in self._schedule for name, _ in self._drafts), "a draft is kept for nobody"
        for row in self._rows:
            assert row.draws
            assert row.pending or row.cursor.done, "a row has nothing to feed"

    def _bring_prompts_on(self, going_on: Sequence[Request]) -> list[StepEvent]:
        """Some tokens of the prompts of those that go on, in order; many while no draw waits for the pass."""
        beginnings = [each for request in going_on for each in self._beginnings if each.request is request]
        if not beginnings:
            return []
        began_s = self._clock()
        left = _ALONE * self._chunk
        if any(row.request in going_on for row in self._rows):
            left = self._chunk
        taken: list[tuple[_Beginning, int]] = []
        for beginning in beginnings:
            if left <= 0:
                break
            count = min(left, self._runner.prompt_tokens)
            taken.append((beginning, count))
            left -= count
        events = self._open([beginning for beginning, _ in taken if beginning.prompt is None])
        parts = [
            (beginning.prompt, count)
            for beginning, count in taken
            if beginning.prompt is not None and beginning in self._beginnings
        ]
        if parts:
            self._runner.feed_prompts(parts)
        read = [each for each in self._beginnings if each.prompt is not None and each.prompt.ready]
        for beginning in read:
            assert beginning.prompt is not None
            self._beginnings.remove(beginning)
            for row in beginning.rows:
                row.begin(beginning.prompt, beginning.prompt.last_token)
                self._rows.append(row)
                if not row.tokens:
                    told = row.write((), self._runner.loaded.vocabulary)
                    events += [(beginning.request.id, event) for event in told]
        self._pace.saw_prompts(self._clock() - began_s, len(read))
        return events

    def _open(self, beginnings: list[_Beginning]) -> list[StepEvent]:
        """Begin prompts, their pictures encoded together; requests whose scene cannot be read fail."""
        asked = [each.request.plan_request for each in beginnings]
        scenes = [(request.scene, request.format) for request in asked]
        events: list[StepEvent] = []
        for beginning, begun in zip(
            beginnings, self._runner.begin_prompts(scenes, len(self._prompts)), strict=True
        ):
            if not isinstance(begun, Exception):
                beginning.prompt = begun
                self._prompts.append(begun)
            elif beginning not in self._beginnings:
                continue  # its request failed with another of its prompts
            elif isinstance(begun, ValueError):
                events.append(self._fail(beginning.request, RequestError(str(begun))))
            else:
                error = EngineError.because("the scene could not be encoded", begun)
                events.append(self._fail(beginning.request, error))
        return events

    def _first_rows(self, request: Request) -> list[Row]:
        """The rows that a request begins with."""
        every = tuple(range(request.controls.n))
        size = self._schedule.draws_a_prompt(request) if self._shortcuts.shared_rows else 1
        return [Row(request.start, request, every[first : first + size]) for first in every[::size]]

    def _feed_of(self, row: Row, place: int, rows: int) -> Feed:
        """A row's pending tokens and what is proposed behind them, with the decisions among both.

        Args:
            row: to be fed.
            place: which it is.
            rows: in the pass.
        """
        assert row.prompt is not None
        if not self._shortcuts.jump and len(row.pending) > 1:
            return Feed(place, row.prompt, row.held, row.pending[:1], ())
        tokens, wanted = self._ahead.feed(row, rows if self._shortcuts.speculate else 0)
        return Feed(place, row.prompt, row.held, tokens, wanted)

    def _apply(self, row: Row, feed: Feed, found: list[Logits]) -> list[StepEvent]:
        """Choose at the decisions of a feed, one after the other, while what was fed is what is chosen."""
        events: list[StepEvent] = []
        row.passes += 1
        held = row.held
        ahead = feed.tokens[len(row.pending) :]
        row.saw(min(len(row.pending), len(feed.tokens)))
        for logits in found:
            events += self._choose(row, logits, ahead[0] if ahead else None)
            agreed = 0
            while agreed < min(len(row.pending), len(ahead)) and row.pending[agreed] == ahead[agreed]:
                agreed += 1
            row.saw(agreed)
            ahead = ahead[agreed:]
            if row.pending:
                break
        self.counts.kept += row.held - held
        return events

    def _choose(self, row: Row, logits: Logits, proposed: int | None) -> list[StepEvent]:
        """Write what the row's draws choose; those that choose otherwise get rows of their own.

        The row goes on with those that choose ``proposed``, if any do.
        """
        time_for = self._pace.time_for(row.request.deadline_s, self._clock())
        chosen = sorted(row.choices(logits, time_for), key=lambda choice: choice[0] != proposed)
        self._ahead.saw(row, len(logits), chosen)
        parts = [(row.part(draws), token) for token, draws in chosen[1:]]
        if row.request.drafts and row.cursor.allowed().choice == BRANCH:
            direct = next(
                int(id) for id in row.cursor.allowed().ids if branch_of(row.cursor, int(id)) == ACTION
            )
            thinking = [draws for token, draws in chosen if branch_of(row.cursor, token) == THINKING]
            parts += [(row.part(draws, draft=True), direct) for draws in thinking]
        token, row.draws = chosen[0]
        vocabulary = self._runner.loaded.vocabulary
        events = row.write((token,), vocabulary)
        for part, token in parts:
            self._runner.copy_row(self._rows.index(row), len(self._rows))
            self._rows.append(part)
            events += part.write((token,), vocabulary)
        return [(row.request.id, event) for event in events]

    def _count(self, rows: list[Row], feeds: list[Feed]) -> None:
        counts = self.counts
        counts.passes += 1
        counts.row_passes += len(rows)
        counts.fan_out_row_passes += sum(len(row.draws) for row in rows)
        counts.scene_passes += len({id(row.prompt) for row in rows})
        counts.tokens += sum(len(feed.tokens) for feed in feeds)

    def _end_the_done(self) -> list[StepEvent]:
        """Take finished rows out, and read their responses."""
        events: list[StepEvent] = []
        for row in [row for row in self._rows if row.cursor.done]:
            if row not in self._rows:
                continue  # its request failed with another of its rows
            try:
                draws = read(
                    row.request.plan_request,
                    row,
                    row.passes,
                    row.draws,
                    self._runner.loaded.vocabulary,
                    self._runner.loaded.codec,
                )
                if not row.draft:
                    self._ahead.finished(row)
            except Exception as error:  # a response that cannot be read back must not end the others
                failure = EngineError.because("a response could not be read back", error)
                events.append(self._fail(row.request, failure))
                continue
            if row.passes_before_ending:
                self._pace.saw_ending(row.passes - row.passes_before_ending)
            else:
                self._pace.saw_direct(row.passes)
            if row.draft:
                events += [(row.request.id, DraftFinished(draw)) for draw in draws]
                self._drafts.update({(row.request.id, draw.index): draw for draw in draws})
                self._free_row(row)
                continue
            self._free_row(row)
            events += self._answer(row.request, draws)
        return events

    def _settle_for_drafts(self) -> list[StepEvent]:
        """Answer with drafts where the reflection will not end in time, of requests that gave way too."""
        events: list[StepEvent] = []
        now_s = self._clock()
        for row in self._every_row():
            if row.draft or not self._pace.last_step(row.request.deadline_s, now_s):
                continue
            ready = [draw for draw in row.draws if (row.request.id, draw) in self._drafts]
            if not ready:
                continue
            self._take_out(row, ready)
            drafts = [self._drafts[row.request.id, draw] for draw in ready]
            events += self._answer(row.request, [replace(draft, cut="replaced") for draft in drafts])
        return events

    def _answer(self, request: Request, draws: list[Draw]) -> list[StepEvent]:
        """Finished draws; what was kept for them is forgotten, and the request with its last draw."""
        answered = [draw.index for draw in draws]
        for index in answered:
            self._drafts.pop((request.id, index), None)
        for row in self._every_row():
            if row.request is request and row.draft:
                self._take_out(row, answered)
        if all(row.request is not request for row in self._every_row()):
            self._schedule.release(request.id)
            self._paused.pop(request.id, None)
        return [(request.id, DrawFinished(draw)) for draw in draws]

    def _every_row(self) -> list[Row]:
        """Those that run, those that wait for their prompt, and those of requests that gave way."""
        waiting = [each.rows for each in self._beginnings]
        return [*self._rows, *chain.from_iterable([*waiting, *self._paused.values()])]

    def _take_out(self, row: Row, draws: Collection[int]) -> None:
        """Go on without some of a row's draws, and without the row when none are left."""
        row.draws = tuple(draw for draw in row.draws if draw not in draws)
        if row.draws:
            return
        if row in self._rows:
            self._free_row(row)
            return
        if row in (paused := self._paused.get(row.request.id, [])):
            paused.remove(row)
            return
        beginning = next(each for each in self._beginnings if row in each.rows)
        beginning.rows.remove(row)
        if not beginning.rows:
            self._drop_beginning(beginning)

    def _fail_without_numbers(self, request: Request) -> StepEvent:
        """End a request whose logits are no numbers, and let nobody read what it has written."""
        for prompt in {id(row.prompt): row.prompt for row in self._rows if row.request is request}.values():
            assert prompt is not None
            self._runner.wipe_prompt(prompt)
        return self._fail(request, EngineError("the network gave logits that are no numbers"))

    def _fail(self, request: Request, error: Exception) -> StepEvent:
        self.cancel(request.id)
        return request.id, Failed(error)

    def _free_row(self, row: Row) -> None:
        """Give up a row, and its prompt if it was the last to use it; the last row moves into its place."""
        index, last = self._rows.index(row), self._rows.pop()
        if last is not row:
            self._runner.copy_row(len(self._rows), index)
            self._rows[index] = last
        assert row.prompt is not None
        if all(other.prompt is not row.prompt for other in self._rows):
            self._free_prompt(row.prompt)

    def _free_prompt(self, prompt: Prompt) -> None:
        last = self._prompts.pop()
        if last is not prompt:
            self._prompts[prompt.row] = last
            self._runner.move_prompt(last, prompt.row)
