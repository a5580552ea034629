"""A response while it is being written, in whichever engine."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from model.formats.cursor import Cursor, Token
from model.network.vocabulary import Vocabulary


class FinishedSection(NamedTuple):
    """A section's name and its text."""

    name: str
    text: str


@dataclass(eq=False)
class Response:
    """What is written so far.

    Attributes:
        cursor: where the response stands, behind everything in ``tokens``.
        tokens: the response so far.
        think_probability: at the branch, once that is decided.
    """

    cursor: Cursor
    tokens: list[Token] = field(default_factory=list, kw_only=True)
    think_probability: float | None = field(default=None, kw_only=True)

    def append(self, token: int, vocabulary: Vocabulary) -> list[FinishedSection]:
        """Write one token; returns the section that it finishes, if any.

        Raises:
            FormatError: the format does not allow it here.
        """
        before, self.cursor = self.cursor.section, self.cursor.advance(token)
        self.tokens.append(Token(token, before))
        return self._finished(before, self.cursor.section, vocabulary)

    def append_forced(self, vocabulary: Vocabulary) -> list[FinishedSection]:
        """Write the run that is forced from here; returns the sections that it finishes."""
        run, self.cursor = self.cursor.forced()
        finished: list[FinishedSection] = []
        sections = [*(token.section for token in run[1:]), self.cursor.section]
        for token, then in zip(run, sections[: len(run)], strict=True):
            self.tokens.append(token)
            finished += self._finished(token.section, then, vocabulary)
        return finished

    def _finished(self, section: str, then: str, vocabulary: Vocabulary) -> list[FinishedSection]:
        """``section``, when the next token belongs to another."""
        if section == then:
            return []
        text = vocabulary.decode([token.id for token in self.tokens if token.section == section])
        return [FinishedSection(section, text)]
