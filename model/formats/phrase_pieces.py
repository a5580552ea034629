"""A reflection in phrases as a piece: `looktwice.model.driving.phrases`, one decision a text.

Its value is its text. Only such reflections can be written as the first plan leaves room for: nobody who
waits can be told to slow down.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from looktwice.model.driving.direction import CHANGES, Change, group_of, needed
from looktwice.model.driving.phrases import (
    CONSEQUENCES,
    CORRECTIONS,
    END,
    GOING_ON,
    HEADS,
    NOTHING,
    SPACE,
    Correction,
    Head,
    PhraseError,
    change_of,
    consequences,
    details,
    read_facts,
)
from looktwice.model.driving.plan import GROUPS, TICKS
from looktwice.model.formats.pieces import (
    Choice,
    Compound,
    Format,
    FormatError,
    Literal,
    Maybe,
    Narrowing,
    Option,
    Piece,
    Sequence,
    Shorthand,
    Value,
    walk,
)
from looktwice.model.formats.plan_tracks import written_plan

_ALL: Final = frozenset(CHANGES)


@dataclass(frozen=True)
class ReflectionPhrases(Narrowing):
    """A reflection on the first plan: statements of changes that this plan leaves room for, or none.

    Attributes:
        first_plan: the section that it is in.
    """

    first_plan: str

    @property
    def sections(self) -> tuple[str, ...]:
        """The first plan's."""
        return (self.first_plan,)

    def expand(self) -> Piece:
        """Statements of any changes."""
        return Phrases()

    def narrowed(self, written: Mapping[str, str]) -> Piece:
        """Statements of what can be changed in the first plan."""
        plan = written_plan(written[self.first_plan])
        return Phrases(frozenset(change for change in CHANGES if needed(plan, change) <= TICKS))


def in_phrases(format: Format) -> bool:
    """Whether a format writes reflections in phrases."""
    return any(isinstance(each, ReflectionPhrases | Phrases) for each in walk(format.body))


@dataclass(frozen=True)
class Phrases(Compound):
    """Statements of some changes, one for each track at most, in the order of a plan's tracks; or none."""

    changes: frozenset[Change] = _ALL
    name: str | None = None

    def expand(self) -> Piece:
        """That nothing is to be changed, or a statement and what follows it."""
        return Choice((Option(NOTHING), *_statements(self.changes)))

    def join(self, parts: tuple[Value, ...]) -> str:
        """The text of decisions."""
        text = ""
        for part in parts:
            if isinstance(part, bool):
                text += SPACE * part
            elif part in CONSEQUENCES:
                text += f"{END}{GOING_ON}{part}"
            else:
                text += f"{part}{END * (part in CORRECTIONS)}"
        return text

    def split(self, value: Value) -> tuple[Value, ...]:
        """The decisions of a text."""
        if not isinstance(value, str):
            raise FormatError(f"a reflection is a text, not {value!r}")
        try:
            statements = read_facts(value).statements
        except PhraseError as error:
            raise FormatError(f"{value!r} is no reflection in phrases: {error}") from error
        if not statements:
            return (NOTHING,)
        parts, changes = list[Value](), self.changes
        for place, statement in enumerate(statements, 1):
            if statement.change not in changes:
                raise FormatError(f"{str(statement)!r}: the plan leaves no room for {statement.change!r}")
            parts += statement.texts()
            changes = _later(changes, statement.change)
            if changes:
                parts.append(place < len(statements))
        return tuple(parts)


@dataclass(frozen=True)
class _Reason(Shorthand):
    """What is behind a cue: what would come of it, what to do instead, and further statements."""

    head: Head
    changes: frozenset[Change]

    def expand(self) -> Piece:
        """In simpler pieces."""
        texts_of = {consequence: text for text, consequence in CONSEQUENCES.items()}
        options = []
        for consequence, corrections in consequences(self.head).items():
            if possible := [each for each in corrections if change_of(each) in self.changes]:
                options.append(Option(texts_of[consequence], self._corrections(possible)))
        return Sequence((Literal(END), Literal(GOING_ON), Choice(tuple(options))))

    def _corrections(self, possible: list[Correction]) -> Choice:
        return Choice(
            tuple(
                Option(text, _more(_later(self.changes, change_of(correction))))
                for text, correction in CORRECTIONS.items()
                if correction in possible
            )
        )


def _statements(changes: frozenset[Change]) -> tuple[Option, ...]:
    """The heads of statements that may ask for one of some changes, each with what follows it."""
    return tuple(
        Option(
            text,
            Sequence(
                (*(Choice(tuple(map(Option, texts))) for texts in details(head)), _Reason(head, changes))
            ),
        )
        for text, head in HEADS.items()
        if any(change_of(each) in changes for found in consequences(head).values() for each in found)
    )


def _more(changes: frozenset[Change]) -> Piece:
    """The end of a statement, and another one where one is left."""
    if not changes:
        return Literal(END)
    return Sequence((Literal(END), Maybe(Sequence((Literal(SPACE), _Statement(changes))))))


@dataclass(frozen=True)
class _Statement(Shorthand):
    """A further statement."""

    changes: frozenset[Change]

    def expand(self) -> Piece:
        """The heads that it may begin with."""
        return Choice(_statements(self.changes))


def _later(changes: frozenset[Change], stated: Change) -> frozenset[Change]:
    """What may be stated behind a statement: changes of later tracks."""
    tracks = GROUPS[GROUPS.index(group_of(stated)) + 1 :]
    return frozenset(change for change in changes if group_of(change) in tracks)
