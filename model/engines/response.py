"""A response while it is being written, in whichever engine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from looktwice.model.driving.plan import Plan
from looktwice.model.engines.engine import Cut
from looktwice.model.formats.cursor import Cursor, FormatVocabulary, Token
from looktwice.model.formats.pieces import Values
from looktwice.model.formats.text import parse_beginning

_HALF_A_CHARACTER: Final = "\ufffd"


class SectionText(NamedTuple):
    """A section's name, and its text or a part of it."""

    name: str
    text: str


@dataclass(eq=False)
class Response:
    """What is written so far.

    Attributes:
        cursor: where the response stands, behind everything in ``tokens``.
        tokens: the response so far.
        logprobs: of the tokens; None where they are forced, or nobody asks.
        think_probability: at the branch, once that is decided.
        chosen: how many tokens were chosen where the format left more than one.
        cut: what a deadline did to the second look, or to the picture.
        streamed: how many characters of the free text being written `new_text` has returned.
    """

    cursor: Cursor
    tokens: list[Token] = field(default_factory=list, kw_only=True)
    logprobs: list[float | None] = field(default_factory=list, kw_only=True)
    think_probability: float | None = field(default=None, kw_only=True)
    chosen: int = field(default=0, kw_only=True)
    cut: Cut | None = field(default=None, kw_only=True)
    streamed: int = field(default=0, kw_only=True)

    def append(
        self, token: int, vocabulary: FormatVocabulary, logprob: float | None = None
    ) -> list[SectionText]:
        """Write one token, chosen with a log-probability; returns the section that it finishes, if any.

        Raises:
            FormatError: the format does not allow it here.
        """
        self.chosen += len(self.cursor.allowed().ids) > 1
        before, self.cursor = self.cursor.section, self.cursor.advance(token)
        self.tokens.append(Token(token, before))
        self.logprobs.append(logprob)
        return self._finished(before, self.cursor.section, vocabulary)

    def append_forced(self, vocabulary: FormatVocabulary) -> list[SectionText]:
        """Write the run that is forced from here; returns the sections that it finishes."""
        run, self.cursor = self.cursor.forced()
        finished: list[SectionText] = []
        sections = [*(token.section for token in run[1:]), self.cursor.section]
        for token, then in zip(run, sections[: len(run)], strict=True):
            self.tokens.append(token)
            self.logprobs.append(None)
            finished += self._finished(token.section, then, vocabulary)
        return finished

    def new_text(self, vocabulary: FormatVocabulary) -> SectionText | None:
        """What a free text has grown by since this was last asked; None outside of free text."""
        count = self.cursor.text_tokens
        if count is None:
            self.streamed = 0
            return None
        text = vocabulary.decode([token.id for token in self.tokens[len(self.tokens) - count :]])
        # What may turn out to be the stop is not told before it does not.
        text = text[: len(text) - self.cursor.stop_characters]
        if len(text) <= self.streamed or text.endswith(_HALF_A_CHARACTER):
            return None
        new, self.streamed = text[self.streamed :], len(text)
        return SectionText(self.cursor.section, new)

    def values(self, vocabulary: FormatVocabulary, given: Mapping[str, Plan]) -> Values:
        """The values of the sections that are finished; of others there may be some.

        Args:
            given: plans that the response began with, by section.
        """
        text = vocabulary.decode([token.id for token in self.tokens])
        return parse_beginning(self.cursor.compiled, text, given)

    def _finished(self, section: str, then: str, vocabulary: FormatVocabulary) -> list[SectionText]:
        """``section``, when the next token belongs to another."""
        if section == then:
            return []
        text = vocabulary.decode([token.id for token in self.tokens if token.section == section])
        return [SectionText(section, text)]
