"""ELF-VLA's responses (supplement, figure 6): thoughts, then eight poses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, cast

import numpy as np

from looktwice.model.driving import sentences
from looktwice.model.driving.sentences import END, SPACE, ThoughtError, Word, Words, decisions, joined
from looktwice.model.driving.trajectory import HALF_SECONDS_S, FloatArray, wrap_angle
from looktwice.model.formats.compounds import DIGITS, Number, Repeat
from looktwice.model.formats.pieces import (
    Choice,
    Compound,
    Format,
    FormatError,
    FreeText,
    Literal,
    Option,
    Piece,
    Record,
    Section,
    Sequence,
    Value,
)

THINK: Final = "think"
ANSWER: Final = "answer"

TIMES_S: Final = HALF_SECONDS_S
MAX_THINK_TOKENS: Final = 320
"""Of free text; the sentences of `looktwice.model.driving.sentences` are shorter."""

_NUMBERS: Final = {
    "x_m": Number(-20.0, 140.0, 0.1, name="x_m"),
    "y_m": Number(-50.0, 50.0, 0.1, name="y_m"),
    "heading_rad": Number(-3.14, 3.14, 0.02, name="heading_rad"),
}
"""Of a pose; where numbers are tokens, their names are those of the alphabets. 140 m within 4 s are 126 km/h.
Steps of 0.1 m make errors of 0.03 m on average, those of 0.02 rad 0.3 degrees: less than models miss by."""
_COLUMNS: Final = {"x_m": 0, "y_m": 1, "heading_rad": 3}


def _pose(*, tokens: bool) -> Record:
    """One pose, such as ``[12.3, -0.4, 0.06]``."""
    x, y, heading = (
        replace(number, spelling=name if tokens else DIGITS) for name, number in _NUMBERS.items()
    )
    return Record(
        Sequence((Literal("["), x, Literal(", "), y, Literal(", "), heading, Literal("]"))), name="pose"
    )


def poses(count: int, *, tokens: bool = False) -> Repeat:
    """So many poses, their numbers in digits or as one token each."""
    return Repeat(_pose(tokens=tokens), count, count, between=", ")


def pose_values(trajectory: FloatArray) -> tuple[dict[str, float], ...]:
    """Poses [t, 4] as a value of `poses`, as near as they can be said: what lies beyond is cut off."""
    seen = trajectory.astype(np.float64)
    seen[:, 3] = wrap_angle(seen[:, 3])
    return tuple(
        {name: number.nearest(float(row[_COLUMNS[name]])) for name, number in _NUMBERS.items()}
        for row in seen
    )


def read_poses(value: Value) -> FloatArray:
    """The trajectory float32 [t, 4] of a value of `poses`; the ego stays on its level."""
    assert isinstance(value, tuple)
    trajectory = np.zeros((len(value), 4), np.float32)
    for row, each in zip(trajectory, cast("tuple[dict[str, float], ...]", value), strict=True):
        for name, column in _COLUMNS.items():
            row[column] = each[name]
    return trajectory


def _in_words(words: Words) -> Choice:
    """A decision between texts, and those that follow it."""
    return Choice(tuple(Option(text, _then(word)) for text, word in words.items()))


def _then(word: Word) -> Piece:
    return Sequence(tuple(map(_in_words, word.then)))


@dataclass(frozen=True)
class _Sentences(Compound):
    """Thoughts in the sentences of `looktwice.model.driving.sentences`; their value is their text."""

    name: str | None = None

    def expand(self) -> Piece:
        """All sentences, each decision a choice."""
        parts = list[Piece]()
        for number, sentence in enumerate(sentences.SENTENCES):
            parts.append(Literal((SPACE if number else "") + sentence.start))
            parts += [_in_words(words) for words in sentence.words]
            parts.append(Literal(END))
        return Sequence(tuple(parts))

    def join(self, parts: tuple[Value, ...]) -> str:
        """The text of decisions."""
        return joined(tuple(map(str, parts)))

    def split(self, value: Value) -> tuple[Value, ...]:
        """The decisions of a text."""
        if not isinstance(value, str):
            raise FormatError(f"thoughts are a text, not {value!r}")
        try:
            return decisions(value)
        except ThoughtError as error:
            raise FormatError(f"{value!r} are no thoughts: {error}") from error


SENTENCES: Final = _Sentences()


def _elf_vla(name: str, thoughts: Piece, *, tokens: bool) -> Format:
    think = Section(THINK, Sequence((Literal("<think>"), thoughts)))
    eight = poses(len(TIMES_S), tokens=tokens)
    answer = Sequence((Literal("<answer>"), eight, Literal("</answer><|im_end|>")))
    return Format(name, Sequence((think, Section(ANSWER, answer))))


def free_text(name: str) -> Format:
    """For public checkpoints: thoughts in any words, numbers in digits."""
    return _elf_vla(name, FreeText("</think>", MAX_THINK_TOKENS, multiline=True), tokens=False)


def phrases(name: str) -> Format:
    """For small checkpoints: thoughts in `looktwice.model.driving.sentences`, one token each number."""
    return _elf_vla(name, Sequence((SENTENCES, Literal("</think>"))), tokens=True)
