"""Rows of the batch: draws that have written the same tokens share one. No torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from looktwice.model.engines.engine import Event
from looktwice.model.engines.engine_requests import drawn_as, events_of, leads_to_reflection
from looktwice.model.engines.least_error import least_error
from looktwice.model.engines.response import Response, SectionText
from looktwice.model.engines.sampling import choose, probabilities, uniforms
from looktwice.model.engines.torch.deadlines import TimeFor
from looktwice.model.formats.cursor import Allowed
from looktwice.model.network.vocabulary import Vocabulary

if TYPE_CHECKING:
    from looktwice.model.engines.torch.request import Request, Tree


@dataclass(eq=False)
class Row(Response):
    """One row of the batch: a response, and the draws that have written it.

    Attributes:
        tree: that it stands in.
        draws: indices of the draws, at least one.
        entry: of the row in the slot table; None while its tree has no memory.
        pending: tokens that the network has not seen yet: the prompt's last one, then those of the response.
        held: how many tokens are in memory behind the prompt.
        draft: whether it is a direct trajectory beside a reflection.
        passes: how many it took part in.
        passes_before_ending: how many up to where a second look can no longer be cut: the branch, or the end
            of the text behind it. 0 without one.
        passes_before_picture: how many up to where it chose to imagine a picture; 0 where it did not.
        foreseen: what it would have written at later places, had the guesses before these been right.
    """

    tree: Tree
    draws: tuple[int, ...]
    entry: int | None = None
    pending: list[int] = field(default_factory=list)
    held: int = 0
    draft: bool = False
    passes: int = 0
    passes_before_ending: int = 0
    passes_before_picture: int = 0
    foreseen: Mapping[int, int] = field(default_factory=dict)

    @property
    def request(self) -> Request:
        """Whose."""
        return self.tree.request

    @property
    def shown(self) -> bytes:
        """Tells the format and the pictures of its prompt from others; only while its prompt is there."""
        assert self.tree.prompt is not None
        return self.tree.prompt.shown

    @property
    def may_imagine(self) -> bool:
        """Whether it stands where it decides about a picture."""
        imagination = self.request.family.imagination
        return imagination is not None and self.cursor.allowed().choice == imagination.name

    def start(self, last_token: int) -> None:
        """Begin, or go on after a preemption, behind a prompt: all that was written is to be fed again."""
        self.held = 0
        self.pending = [last_token, *(token.id for token in self.tokens)]

    def part(self, draws: tuple[int, ...], *, draft: bool = False) -> Row:
        """A row of its own for some of the draws."""
        return replace(
            self,
            draws=draws,
            pending=list(self.pending),
            tokens=list(self.tokens),
            logprobs=list(self.logprobs),
            draft=self.draft or draft,
        )

    def fed(self, count: int) -> None:
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
        chosen: dict[int, list[int]] = {}
        tokens = self._selected(allowed, logits, self.draws, len(self.tokens), left)
        for draw, token in zip(self.draws, tokens, strict=True):
            chosen.setdefault(token, []).append(draw)
        return [(token, tuple(draws)) for token, draws in chosen.items()]

    def would_choose(self, logits: npt.NDArray[np.float64], place: int) -> int:
        """What the first draw chooses from these logits if it writes at ``place`` what it may write now."""
        [token] = self._selected(self.cursor.allowed(), logits, self.draws[:1], place)
        return token

    def _selected(
        self,
        allowed: Allowed,
        logits: npt.NDArray[np.float64],
        draws: Sequence[int],
        place: int,
        left: npt.NDArray[np.bool_] | None = None,
    ) -> list[int]:
        """What each of some draws chooses at a place of the response, among the allowed ids that are left."""
        controls = self.request.controls
        expected = self.request.least_error.expected(allowed, controls)
        if expected is not None:
            return [int(allowed.ids[least_error(logits, expected, left)])] * len(draws)
        if left is None:
            left = np.ones(len(allowed.ids), np.bool_)
        request = self.request
        lots = drawn_as(request.plan_request, request.family, self.cursor, draws)
        numbers = uniforms(controls.seed, lots, place)
        places = choose(logits[left], controls.temperature, controls.top_p, numbers)
        return [int(token) for token in allowed.ids[left][places]]

    def write(self, token: int | None, vocabulary: Vocabulary, logprob: float | None = None) -> list[Event]:
        """Append a token that was chosen, if any, and the forced run behind it; returns what they finish."""
        written, finished = len(self.tokens), list[SectionText]()
        was_text = self.cursor.stop_id is not None
        reflects = token is not None and self._reflects(token)
        if token is not None and self._imagines(token):
            self.passes_before_picture = self.passes
        if token is not None:
            finished += self.append(token, vocabulary, logprob)
        if reflects or (was_text and self.cursor.stop_id is None):
            self.passes_before_ending = self.passes
        finished += self.append_forced(vocabulary)
        self.pending += [token.id for token in self.tokens[written:]]
        if self.draft:
            return []
        return events_of(
            self.request.plan_request, self.request.family, self, finished, self.draws, vocabulary
        )

    def _controlled(
        self, allowed: Allowed, logits: npt.NDArray[np.float64], time_for: TimeFor
    ) -> npt.NDArray[np.bool_]:
        """Which of the allowed ids the request's controls and its deadline leave."""
        controls = self.request.controls
        everything = np.ones(len(allowed.ids), np.bool_)
        family = self.request.family
        if self.may_imagine and time_for is TimeFor.END_NOW:
            self.cut = "skipped"
            return np.array([not self._imagines(int(token)) for token in allowed.ids])
        if family.branch is None or allowed.choice != family.branch.name:
            if self.cursor.stop_id in allowed.ids and self._ends(time_for):
                self.cut = "shortened"
                stops: npt.NDArray[np.bool_] = allowed.ids == self.cursor.stop_id
                return stops
            binding, reason_mask = self.request.binding, self.request.reason_mask
            bound = None if binding is None else binding.leaves(allowed.ids, self.tokens, family.plans)
            if bound is None and reason_mask is not None:
                bound = reason_mask.leaves(self.cursor, self.tokens)
            return everything if bound is None else bound
        leads = np.array(
            [leads_to_reflection(family.branch, self.cursor, int(token)) for token in allowed.ids]
        )
        self.think_probability = float(probabilities(logits)[leads].sum())
        wanted = controls.second_look(self.think_probability)
        if time_for is TimeFor.END_NOW and wanted is not False:
            self.cut, wanted = "skipped", False
        if wanted is None:
            return everything
        return leads if wanted else ~leads

    def _reflects(self, token: int) -> bool:
        """Whether a token of the branch leads to a second look."""
        branch = self.request.family.branch
        if branch is None or self.cursor.allowed().choice != branch.name:
            return False
        return leads_to_reflection(branch, self.cursor, token)

    def _imagines(self, token: int) -> bool:
        """Whether a token begins a picture."""
        imagination = self.request.family.imagination
        if imagination is None or not self.may_imagine:
            return False
        return imagination.imagined in self.cursor.option_texts(token)

    def _ends(self, time_for: TimeFor) -> bool:
        """Whether a text stops here."""
        if time_for is TimeFor.END_SENTENCE:
            return self.tokens[-1].id in self.cursor.compiled.sentence_ends
        return time_for is TimeFor.END_NOW
