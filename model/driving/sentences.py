"""The sentences that thoughts are written in (`looktwice.model.driving.thoughts`), as tables.

Every text in a table is one decision of the model that writes it, and stands for a meaning. So each text is
read as meanings again, and what cannot be written cannot be stated either.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

from looktwice.model.driving.high_level import Lateral, Longitudinal
from looktwice.model.driving.phrases import FARTHEST_M, STEP_M

EDGE_STEP_M: Final = 0.5
EDGE_FARTHEST_M: Final = 3.0
"""Road edges are told in such steps up to there: a lane's width farther away, nobody steers by them."""

Meaning = str | int | float | bool | None


class ThoughtError(ValueError):
    """A text that does not tell thoughts, or facts that there are no words for; the text says why."""


@dataclass(frozen=True)
class Word:
    """What a text means, and the tables of what follows it."""

    meaning: Meaning
    then: tuple[Words, ...] = ()


Words = dict[str, Word]
"""The texts that a decision is between."""


@dataclass(frozen=True)
class Sentence:
    """What a sentence begins with, and its decisions."""

    start: str
    words: tuple[Words, ...] = field(repr=False)


END: Final = "."
SPACE: Final = " "


def _words(meanings: Mapping[str, Meaning], *then: Words) -> Words:
    return {text: Word(meaning, then) for text, meaning in meanings.items()}


def _edge(side: str) -> Words:
    steps = [EDGE_STEP_M * step for step in range(round(EDGE_FARTHEST_M / EDGE_STEP_M) + 1)]
    return _words({**{f"{side}{metres:.1f} m": metres for metres in steps}, f"{side}far": None})


def _ahead(end: str, at_once: str) -> Words:
    return _words(
        {at_once: 0, **{f" {metres} m{end}": metres for metres in range(STEP_M, FARTHEST_M + 1, STEP_M)}}
    )


_AHEAD: Final = _ahead(" ahead", " right ahead")
_ORIGINS: Final = _words({" from the left": "left", " from the right": "right", " oncoming": "oncoming"})
_SIDES: Final = _words({" from the left": "left", " from the right": "right"}, _ahead(" ahead", " beside me"))
_ORDER: Final = _words({", before me": True, ", after me": False})
_NOBODY: Final = _words({" nobody": None})
_STATES: Final[Mapping[str, Meaning]] = {
    " a vehicle": "",
    " a standing vehicle": "standing",
    " a slower vehicle": "slower",
    " a braking vehicle": "braking",
}
_BESIDE: Final[Mapping[str, Meaning]] = {
    ", no lane beside": "none",
    ", a lane on the left": "left",
    ", a lane on the right": "right",
    ", lanes on both sides": "both",
}
_LATERAL: Final[Mapping[Lateral, str]] = {
    "keep": " and keep the lane",
    "turn left": " and turn left",
    "turn right": " and turn right",
    "change left": " and change to the left lane",
    "change right": " and change to the right lane",
}
_LONGITUDINAL: Final[Mapping[Longitudinal, str]] = {
    "accelerate": " accelerate",
    "decelerate": " decelerate",
    "maintain": " maintain the speed",
    "stop": " stop",
}

SENTENCES: Final = (
    Sentence("Road edges:", (_edge(" left "), _edge(", right "))),
    Sentence("In my lane:", (_NOBODY | _words(_STATES, _AHEAD),)),
    Sentence("Merging:", (_NOBODY | _SIDES,)),
    Sentence(
        "Crossing:",
        (
            _NOBODY
            | _words({" a vehicle": "vehicle", " a pedestrian": "pedestrian"}, _ORIGINS, _AHEAD, _ORDER),
        ),
    ),
    Sentence(
        "Road:",
        (
            _words({" straight": None})
            | _words({" bends left": "left", " bends right": "right"}, _ahead(" ahead", " here")),
            _words(_BESIDE),
            _words({", nothing in the way": None})
            | _words({f", a {kind} in the way": kind for kind in ("cone", "barrier", "pedestrian")}, _AHEAD),
        ),
    ),
    Sentence(
        "Next:",
        (
            _words({text: each for each, text in _LONGITUDINAL.items()}),
            _words({text: each for each, text in _LATERAL.items()}),
        ),
    ),
)
"""Thoughts are all of these sentences, in this order."""


def joined(texts: tuple[str, ...]) -> str:
    """The text whose decisions are ``texts``; raises `ThoughtError` for any others."""
    left = iter(texts)
    written = [
        sentence.start + "".join(each for words in sentence.words for each in _taken(words, left)) + END
        for sentence in SENTENCES
    ]
    if rest := list(left):
        raise ThoughtError(f"nothing may follow the last sentence, as does {rest[0]!r}")
    return SPACE.join(written)


def decisions(text: str) -> tuple[str, ...]:
    """The texts of the decisions of a text, the inverse of `joined`; raises `ThoughtError`."""
    reader, found = _SentenceReader(text), list[str]()
    for number, sentence in enumerate(SENTENCES):
        reader.expect((SPACE if number else "") + sentence.start)
        for words in sentence.words:
            found += reader.decisions(words)
        reader.expect(END)
    if rest := text[reader.place :]:
        raise ThoughtError(f"nothing may follow the last sentence, as does {rest[:40]!r}")
    return tuple(found)


def texts_of(meanings: Iterable[Meaning]) -> tuple[str, ...]:
    """The texts of decisions that mean ``meanings``; raises `ThoughtError` without words for one."""
    left = iter(meanings)
    texts = [text for sentence in SENTENCES for words in sentence.words for text in _written(words, left)]
    if rest := list(left):
        raise ThoughtError(f"there are no words for {rest[0]!r}")
    return tuple(texts)


def meanings_of(text: str) -> tuple[Meaning, ...]:
    """What a text means, the inverse of `texts_of` and `joined`; raises `ThoughtError`."""
    left = iter(decisions(text))
    return tuple(
        meaning for sentence in SENTENCES for words in sentence.words for meaning in _meant(words, left)
    )


def _written(words: Words, meanings: Iterator[Meaning]) -> Iterator[str]:
    meant = next(meanings, "nothing")
    # 0 and False are equal, and so are 1.0 and True.
    found = [
        text for text, word in words.items() if word.meaning == meant and type(word.meaning) is type(meant)
    ]
    if not found:
        raise ThoughtError(f"there are no words for {meant!r}; there are some for {', '.join(words)}")
    yield found[0]
    for more in words[found[0]].then:
        yield from _written(more, meanings)


def _taken(words: Words, left: Iterator[str]) -> Iterator[str]:
    text = next(left, "")
    if text not in words:
        raise ThoughtError(f"expected one of {', '.join(map(repr, words))}, found {text!r}")
    yield text
    for more in words[text].then:
        yield from _taken(more, left)


def _meant(words: Words, left: Iterator[str]) -> Iterator[Meaning]:
    word = words[next(left)]
    yield word.meaning
    for more in word.then:
        yield from _meant(more, left)


class _SentenceReader:
    def __init__(self, text: str) -> None:
        self._text, self.place = text, 0

    def expect(self, text: str) -> None:
        """Read ``text``."""
        if not self._text.startswith(text, self.place):
            raise self._error(repr(text))
        self.place += len(text)

    def decisions(self, words: Words) -> Iterator[str]:
        """Read a decision, and those that follow it."""
        # The longest first: a text may be the beginning of another.
        for text in sorted(words, key=len, reverse=True):
            if self._text.startswith(text, self.place):
                break
        else:
            raise self._error(f"one of {', '.join(map(repr, words))}")
        self.place += len(text)
        yield text
        for more in words[text].then:
            yield from self.decisions(more)

    def _error(self, expected: str) -> ThoughtError:
        seen = self._text[self.place : self.place + 40]
        return ThoughtError(f"character {self.place + 1}: expected {expected}, found {seen!r}")
