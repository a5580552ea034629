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
        after, section = self.cursor.advance(token), self.cursor.section
        self.tokens.append(Token(token, section))
        self.cursor = after
        if after.section == section:
            return []
        text = vocabulary.decode([token.id for token in self.tokens if token.section == section])
        return [FinishedSection(section, text)]

    def append_forced(self, vocabulary: Vocabulary) -> list[FinishedSection]:
        """Write the run that is forced from here; returns the sections that it finishes."""
        run, _ = self.cursor.forced()
        return [finished for token, _ in run for finished in self.append(token, vocabulary)]
