"""The decoding loop without threads: admit, run one pass over all rows, apply what was sampled."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from model.engines.engine import DrawFinished, Event, PlanRequest, RequestError
from model.engines.torch.draws import Request, RunningDraw
from model.engines.torch.runner import Runner
from model.formats.cf_vla import FORMATS
from model.formats.cursor import CompiledFormat
from model.formats.pieces import FormatError, Values
from model.formats.text import parse


@dataclass(frozen=True)
class Failed:
    """A request ended without all its draws."""

    error: Exception


StepEvent = tuple[str, Event | Failed]
"""A request id and what happened to it."""


class Decoder:
    """Continuous batching over a runner's rows; every draw of every request is one row.

    Args:
        runner: network and KV rows.
        jump: feed forced runs in one pass; off, every token takes a pass of its own (the plain decoder
            that everything faster is compared with).
    """

    def __init__(self, runner: Runner, *, jump: bool = True) -> None:
        self._runner = runner
        self._jump = jump
        self._waiting: deque[Request] = deque()
        self._running: list[RunningDraw] = []
        vocabulary = runner.loaded.vocabulary
        self._formats = {
            name: CompiledFormat(FORMATS[name], vocabulary) for name in runner.loaded.card.formats
        }

    @property
    def idle(self) -> bool:
        """Whether there is nothing to do."""
        return not self._waiting and not self._running

    def add(self, plan_request: PlanRequest) -> None:
        """Queue a request.

        Raises:
            RequestError: it can never be served: unknown format, too many draws, a missing camera, a
                prefill the format cannot write.
        """
        loaded, controls = self._runner.loaded, plan_request.controls
        if plan_request.format not in self._formats:
            known = ", ".join(self._formats)
            raise RequestError(f"unknown format {plan_request.format!r}; this checkpoint writes {known}")
        if controls.n > self._runner.rows:
            raise RequestError(
                f"n is {controls.n}; this engine runs at most {self._runner.rows} draws at once"
            )
        cameras = {clip.camera for clip in plan_request.scene.clips}
        if missing := [camera for camera in loaded.card.cameras if camera not in cameras]:
            raise RequestError(f"the scene lacks camera {', '.join(missing)}, which this checkpoint needs")
        try:
            self._formats[plan_request.format].start(_given(plan_request))
        except FormatError as error:
            raise RequestError(f"prefill: {error}") from error
        self._waiting.append(Request(plan_request))

    def cancel(self, request_id: str) -> None:
        """Drop a request, whether it waits or runs; its rows are free at once."""
        self._waiting = deque(
            request for request in self._waiting if request.plan_request.request_id != request_id
        )
        for row in reversed(range(len(self._running))):
            if self._running[row].request.plan_request.request_id == request_id:
                self._free(row)

    def step(self) -> list[StepEvent]:
        """Admit what fits, run one pass, and return what happened."""
        events = self._admit()
        if not self._running:
            return events
        fed = [draw.pending if self._jump else draw.pending[:1] for draw in self._running]
        logits = self._runner.decode(
            fed, [draw.held for draw in self._running], [draw.position_offset for draw in self._running]
        )
        for draw, tokens in zip(self._running, fed, strict=True):
            draw.held += len(tokens)
            del draw.pending[: len(tokens)]
        vocabulary = self._runner.loaded.vocabulary
        for row in reversed(range(len(self._running))):
            draw = self._running[row]
            if not draw.pending and not draw.cursor.done:
                sections = draw.take(logits[row], vocabulary)
                events += [(draw.request.plan_request.request_id, event) for event in sections]
            if draw.cursor.done:
                self._free(row)
                events.append((draw.request.plan_request.request_id, self._finish(draw)))
        return events

    def _admit(self) -> list[StepEvent]:
        events: list[StepEvent] = []
        while self._waiting and len(self._running) + self._waiting[0].controls.n <= self._runner.rows:
            request = self._waiting.popleft()
            plan_request = request.plan_request
            try:
                prompt = self._runner.prefill(plan_request.scene, plan_request.format, len(self._running))
            except ValueError as error:
                events.append((plan_request.request_id, Failed(RequestError(str(error)))))
                continue
            start = self._formats[plan_request.format].start(_given(plan_request))
            for index in range(request.controls.n):
                if index:
                    self._runner.copy_row(len(self._running) - index, len(self._running), prompt.held)
                draw = RunningDraw(
                    request, index, start, [prompt.last_token], prompt.held, prompt.position_offset
                )
                sections = draw.write_forced(self._runner.loaded.vocabulary)
                events += [(plan_request.request_id, event) for event in sections]
                self._running.append(draw)
        return events

    def _free(self, row: int) -> None:
        """Give up a row; the last live row moves into its place."""
        last = self._running.pop()
        if row < len(self._running):
            self._runner.copy_row(len(self._running), row, last.held)
            self._running[row] = last

    def _finish(self, draw: RunningDraw) -> Event:
        loaded, request = self._runner.loaded, draw.request.plan_request
        text = loaded.vocabulary.decode([token.id for token in draw.tokens])
        values = parse(FORMATS[request.format], text)
        codes = values["trajectory"]
        assert isinstance(codes, tuple)
        trajectory = loaded.codec.decode(request.scene.history[None], [codes])[0]
        return DrawFinished(draw.finished(text, values, trajectory))


def _given(request: PlanRequest) -> Values:
    prefill = request.controls.prefill
    return {} if prefill is None else {"plan": prefill}
