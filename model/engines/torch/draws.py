"""A draw in the making: what it has written, what goes through the network next. No torch."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from model.driving.plan import Plan
from model.driving.trajectory import FloatArray
from model.engines.engine import Branch, Controls, Draw, Event, PlanRequest, SectionFinished
from model.engines.torch.sampler import choose, probabilities, uniform
from model.formats.cursor import Allowed, Cursor, Token
from model.formats.pieces import ACTION, BRANCH, THINKING, Values
from model.network.vocabulary import Vocabulary


@dataclass
class Request:
    """A request as the engine tracks it."""

    plan_request: PlanRequest
    submitted_s: float = field(default_factory=time.monotonic)

    @property
    def controls(self) -> Controls:
        """What the caller decided."""
        return self.plan_request.controls

    def late(self) -> bool:
        """Whether the deadline has passed: then nothing is begun or continued that can be left out."""
        deadline_ms = self.controls.deadline_ms
        return deadline_ms is not None and time.monotonic() - self.submitted_s > deadline_ms / 1000


@dataclass
class RunningDraw:
    """One row of the batch.

    Attributes:
        cursor: where the response stands, behind everything in ``tokens``.
        pending: tokens of the response (or the prompt's last) that the network has not seen yet.
        held: how many tokens its KV row holds.
        position_offset: what to add to ``held`` for a token's rotary position: pictures take fewer
            positions than tokens.
    """

    request: Request
    index: int
    cursor: Cursor
    pending: list[int]
    held: int
    position_offset: int
    tokens: list[Token] = field(default_factory=list)
    think_probability: float | None = None

    def take(self, logits: npt.NDArray[np.float64], vocabulary: Vocabulary) -> list[Event]:
        """Write the next token out of logits [vocabulary], and the forced run behind it."""
        allowed = self.cursor.allowed()
        ids = self._controlled(allowed, logits)
        controls = self.request.controls
        number = uniform(controls.seed, self.index, len(self.tokens))
        choice = choose(logits[ids], controls.temperature, controls.top_p, number)
        return self.write([int(ids[choice])], vocabulary) + self.write_forced(vocabulary)

    def write_forced(self, vocabulary: Vocabulary) -> list[Event]:
        """Write the forced run at the cursor, if there is one."""
        run, _ = self.cursor.forced()
        return self.write([token.id for token in run], vocabulary)

    def write(self, ids: list[int], vocabulary: Vocabulary) -> list[Event]:
        """Append tokens and return the sections that they finish."""
        events: list[Event] = []
        for token in ids:
            self.tokens.append(Token(token, self.cursor.section))
            self.cursor = self.cursor.advance(token)
            if self.cursor.section != self.tokens[-1].section:
                events.append(self._section_finished(vocabulary))
        self.pending += ids
        return events

    def _controlled(self, allowed: Allowed, logits: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
        """The allowed ids that the request's controls and its deadline leave."""
        controls, late = self.request.controls, self.request.late()
        if allowed.choice != BRANCH:
            if late and allowed.section == "thinking" and self.cursor.stop_id in allowed.ids:
                return np.array([self.cursor.stop_id], np.int64)
            return allowed.ids
        leads = np.array([THINKING in self.cursor.option_texts(int(token)) for token in allowed.ids])
        self.think_probability = float(probabilities(logits[allowed.ids])[leads].sum())
        wanted: Branch | None = None
        if late or controls.thinking == "never":
            wanted = ACTION
        elif controls.thinking == "always":
            wanted = THINKING
        elif controls.think_threshold is not None:
            wanted = THINKING if self.think_probability > controls.think_threshold else ACTION
        if wanted is None:
            return allowed.ids
        left: npt.NDArray[np.int64] = allowed.ids[leads if wanted == THINKING else ~leads]
        return left

    def _section_finished(self, vocabulary: Vocabulary) -> SectionFinished:
        section = self.tokens[-1].section
        ids = [token.id for token in self.tokens if token.section == section]
        return SectionFinished(self.index, section, vocabulary.decode(ids))

    def finished(self, text: str, values: Values, trajectory: FloatArray) -> Draw:
        """The finished draw."""
        plan, revised = values.get("plan"), values.get("revised_plan")
        branch, thinking, codes = values.get(BRANCH), values.get("thinking"), values["trajectory"]
        assert isinstance(codes, tuple)
        return Draw(
            index=self.index,
            text=text,
            plan=plan if isinstance(plan, Plan) else None,
            branch=THINKING if branch == THINKING else ACTION if branch == ACTION else None,
            think_probability=self.think_probability,
            thinking=thinking if isinstance(thinking, str) else None,
            revised_plan=revised if isinstance(revised, Plan) else None,
            trajectory=trajectory,
            codes=codes,
            tokens=dict(Counter(token.section for token in self.tokens)),
        )
