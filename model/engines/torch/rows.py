"""Rows of the batch: draws that have written the same tokens share one. No torch."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from model.engines.binding import Binding
from model.engines.engine import Controls, Event, PlanRequest, SectionFinished, TextWritten
from model.engines.requests import branch_of
from model.engines.response import Response, SectionText
from model.engines.torch.pace import TimeFor
from model.engines.torch.sampler import choose, probabilities, uniforms
from model.formats.cursor import Allowed, Cursor
from model.formats.pieces import ACTION, BRANCH, THINKING
from model.network.vocabulary import Vocabulary

if TYPE_CHECKING:
    from model.engines.torch.runner import Prompt  # a runner needs torch, rows do not

_arrivals = itertools.count()
_FIRST, _REVISED = "plan", "revised_plan"


@dataclass(eq=False)
class Request:
    """A request as the engine tracks it; times are those of the engine's clock.

    ``binding`` is there where the caller's control ``bind`` asks for it.
    """

    plan_request: PlanRequest
    start: Cursor
    submitted_s: float
    arrival: int = field(default_factory=lambda: next(_arrivals))
    binding: Binding | None = None

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
    def drafts(self) -> bool:
        """Whether a direct trajectory is made beside every reflection."""
        reflects = BRANCH in self.start.compiled.format.sections() and self.controls.thinking != "never"
        return self.controls.deadline_ms is not None and reflects


@dataclass(eq=False)
class Row(Response):
    """One row of the batch: a response, and the draws that have written it.

    Attributes:
        request: whose.
        draws: indices of the draws, at least one.
        prompt: in whose memory its prompt lies; None while it has not begun or is paused.
        pending: tokens (of the response, before it the prompt's last) that the network has not seen yet.
        held: how many tokens its KV row holds.
        draft: whether it is a direct trajectory beside a reflection.
        passes: how many it took part in.
        passes_before_ending: how many up to the end of its text.
    """

    request: Request
    draws: tuple[int, ...]
    prompt: Prompt | None = None
    pending: list[int] = field(default_factory=list)
    held: int = 0
    draft: bool = False
    passes: int = 0
    passes_before_ending: int = 0

    def begin(self, prompt: Prompt, last_token: int) -> None:
        """Begin, or go on after a pause, behind a prompt: all that was written is to be fed again."""
        self.prompt, self.held = prompt, 0
        self.pending = [last_token, *(token.id for token in self.tokens)]

    def part(self, draws: tuple[int, ...], *, draft: bool = False) -> Row:
        """A row of its own for some of the draws."""
        return replace(
            self,
            draws=draws,
            pending=list(self.pending),
            tokens=list(self.tokens),
            draft=self.draft or draft,
        )

    def proposal(self) -> list[int]:
        """What may come behind ``pending``: a revised plan goes on as the first plan did, while it does."""
        if self.cursor.section != _REVISED:
            return []
        first = [token.id for token in self.tokens if token.section == _FIRST]
        revised = [token.id for token in self.tokens if token.section == _REVISED]
        return first[len(revised) :] if first[: len(revised)] == revised else []

    def saw(self, count: int) -> None:
        """The first ``count`` pending tokens went through the network."""
        self.held += count
        self.pending = self.pending[count:]

    def choices(
        self, logits: npt.NDArray[np.float64], time_for: TimeFor
    ) -> list[tuple[int, tuple[int, ...]]]:
        """What the draws choose at the cursor: each token with the draws that choose it, in order.

        Args:
            logits: float64 [k] of the ids that the cursor allows.
            time_for: what a text may still do.
        """
        allowed = self.cursor.allowed()
        left = self._controlled(allowed, logits, time_for)
        ids, controls = allowed.ids[left], self.request.controls
        numbers = uniforms(controls.seed, self.draws, len(self.tokens))
        places = choose(logits[left], controls.temperature, controls.top_p, numbers)
        chosen: dict[int, list[int]] = {}
        for draw, place in zip(self.draws, places, strict=True):
            chosen.setdefault(int(ids[place]), []).append(draw)
        return [(token, tuple(draws)) for token, draws in chosen.items()]

    def write(self, ids: Sequence[int], vocabulary: Vocabulary) -> list[Event]:
        """Append tokens and the forced run behind them; returns the sections that they finish."""
        written, finished = len(self.tokens), list[SectionText]()
        was_text = self.cursor.stop_id is not None
        for token in ids:
            finished += self.append(token, vocabulary)
        if was_text and self.cursor.stop_id is None:
            self.passes_before_ending = self.passes
        finished += self.append_forced(vocabulary)
        self.pending += [token.id for token in self.tokens[written:]]
        if self.draft:
            return []
        events: list[Event] = [
            SectionFinished(index, *section) for section in finished for index in self.draws
        ]
        if self.request.plan_request.live and (new := self.new_text(vocabulary)):
            events += [TextWritten(index, *new) for index in self.draws]
        return events

    def _controlled(
        self, allowed: Allowed, logits: npt.NDArray[np.float64], time_for: TimeFor
    ) -> npt.NDArray[np.bool_]:
        """Which of the allowed ids the request's controls and its deadline leave."""
        controls = self.request.controls
        everything = np.ones(len(allowed.ids), np.bool_)
        if allowed.choice != BRANCH:
            if self.cursor.stop_id in allowed.ids and self._ends(time_for):
                self.cut = "shortened"
                stops: npt.NDArray[np.bool_] = allowed.ids == self.cursor.stop_id
                return stops
            binding = self.request.binding
            bound = None if binding is None else binding.leaves(allowed.ids, self.tokens)
            return everything if bound is None else bound
        leads = np.array([branch_of(self.cursor, int(token)) == THINKING for token in allowed.ids])
        self.think_probability = float(probabilities(logits)[leads].sum())
        wanted = controls.branch(self.think_probability)
        if time_for is TimeFor.END_NOW and wanted != ACTION:
            self.cut, wanted = "skipped", ACTION
        if wanted is None:
            return everything
        return leads if wanted == THINKING else ~leads

    def _ends(self, time_for: TimeFor) -> bool:
        """Whether a text stops here."""
        if time_for is TimeFor.END_SENTENCE:
            return self.tokens[-1].id in self.cursor.compiled.sentence_ends
        return time_for is TimeFor.END_NOW
