"""Free text token by token: what it may hold, where it ends, how a text is spelt.

The text ends where the stop's own tokens have been written, and never spells the stop with other tokens. So
a state counts the tokens written, and remembers how much of the stop they end with: in tokens, and in
characters. The text may still turn out to go on, as in ``speed < 5`` before ``</think>``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from looktwice.model.formats.pieces import FormatError, FreeText

Ids = npt.NDArray[np.int64]


class TextState(NamedTuple):
    """Within free text.

    Attributes:
        used: tokens written, those of the stop included.
        matched: tokens of the stop that the last of them may be.
        seen: characters of the stop that the text ends with.
    """

    used: int = 0
    matched: int = 0
    seen: int = 0


BEGUN = TextState()


@dataclass(frozen=True, eq=False)
class Alphabet:
    """The tokens that free text may hold.

    Attributes:
        mask: bool [vocabulary].
        decode: the text of tokens.
    """

    mask: npt.NDArray[np.bool_]
    decode: Callable[[Sequence[int]], str]

    @cached_property
    def texts(self) -> dict[int, str]:
        """The text of each token."""
        return {int(token): self.decode([int(token)]) for token in np.flatnonzero(self.mask)}

    @cached_property
    def spellings(self) -> dict[str, int]:
        """The inverse of `texts`."""
        return {text: token for token, text in self.texts.items() if text}

    @cached_property
    def first_bytes(self) -> frozenset[int]:
        """The bytes that a text may begin with."""
        return frozenset(text.encode()[0] for text in self.spellings)

    def holds(self, token: int) -> bool:
        """Whether ``token`` is one of them."""
        return 0 <= token < len(self.mask) and bool(self.mask[token])


class TextRules:
    """What the tokens of a free text may be.

    Args:
        piece: the free text.
        stop: the tokens of its stop.
        alphabet: of its text.
        encode: a text as the tokenizer spells it.
    """

    def __init__(
        self,
        piece: FreeText,
        stop: tuple[int, ...],
        alphabet: Alphabet,
        encode: Callable[[str], tuple[int, ...]],
    ) -> None:
        self.stop, self.alphabet = stop, alphabet
        self._text, self._most, self._encode = piece.stop, piece.max_tokens, encode
        free = [alphabet.holds(token) for token in stop]
        self.end = min(len(stop), 1 + (free.index(False) if False in free else len(stop)))
        """With so many tokens of the stop the text is over; what is left of the stop is forced."""
        # No token of a text holds a line break where it has one line.
        self._apart = self.end == 1 and piece.stop[0] == "\n" and not piece.multiline
        self._token_borders, self._borders = _borders(stop), _borders(piece.stop)
        self._allowed: dict[tuple[int, bool], Ids] = {}
        self._seen: dict[int, dict[int, int | None]] = {}

    def allowed(self, state: TextState) -> Ids:
        """Ids of the tokens that may follow, ascending; at least one."""
        used, matched, seen = state
        if used >= self._most:
            # Only what leads to the end; what else begins another stop would make the text too long.
            tokens = {self.stop[border] for border in self._chain(matched)}
            return np.array(sorted(token for token in tokens if self.after(state, token)), np.int64)
        ends = matched == self.end - 1 and used > matched
        key = (seen, ends)
        if key not in self._allowed:
            mask = self.alphabet.mask.copy()
            mask[[token for token, then in self._moves(seen).items() if then is None]] = False
            mask[self.stop[self.end - 1]] |= ends
            self._allowed[key] = np.flatnonzero(mask)
        return self._allowed[key]

    def after(self, state: TextState, token: int) -> TextState | None:
        """The state behind ``token``; None where it is not allowed.

        With ``matched`` equal to `end` the text is over.
        """
        used, matched, seen = state
        ends = token == self.stop[self.end - 1] and matched == self.end - 1
        if ends:
            return TextState(used + 1, self.end) if 1 <= used - matched <= self._most else None
        if not self.alphabet.holds(token):
            return None
        if self._apart:
            return TextState(used + 1) if used < self._most else None
        now_seen = self._moves(seen).get(token, 0)
        if now_seen is None:
            return None
        now_matched = _next(self.stop, self._token_borders, matched, token)
        possible = (used + 1 - border for border in self._chain(now_matched))
        if not any(1 <= length <= self._most for length in possible):
            return None
        return TextState(used + 1, now_matched, now_seen)

    def groups(self, state: TextState) -> dict[TextState, Ids]:
        """The tokens that may follow, by the state that they lead to."""
        allowed = self.allowed(state)
        moves = self._moves(state.seen).keys() | set(self.stop)
        plain = np.array([token not in moves for token in allowed.tolist()], np.bool_)
        found: dict[TextState, list[int]] = {}
        for token in allowed[~plain].tolist():
            if then := self.after(state, token):
                found.setdefault(then, []).append(token)
        groups = {then: np.array(tokens, np.int64) for then, tokens in found.items()}
        if plain.any():
            then = TextState(state.used + 1)
            groups[then] = np.union1d(allowed[plain], groups.get(then, np.empty(0, np.int64)))
        return groups

    @property
    def apart(self) -> bool:
        """Whether no token of the text can be taken for a part of the stop."""
        return self._apart

    def spell(self, text: str) -> tuple[int, ...]:
        """The tokens of a text: the tokenizer's own, or the fewest that may be written where it uses others.

        Raises:
            FormatError: no allowed tokens within the budget spell it, or it holds the stop.
        """
        if not text or (text + self._text).find(self._text) < len(text):
            raise FormatError(f"free text must be text without {self._text!r}, got {text!r}")
        ids = self._encode(text)
        if len(ids) <= self._most and all(map(self.alphabet.holds, ids)) and self._spells(ids, text):
            return ids
        shortest = shortest_spelling(text, self.alphabet.spellings)
        if shortest is None:
            raise FormatError(f"free text holds characters that no allowed token has: {text!r}")
        if len(shortest) > self._most:
            raise FormatError(f"free text of {len(shortest)} tokens; at most {self._most} are allowed")
        return shortest

    def _spells(self, ids: tuple[int, ...], text: str) -> bool:
        return self.alphabet.decode(ids) == text

    def _chain(self, matched: int) -> list[int]:
        """``matched``, and all shorter beginnings of the stop that the tokens end with, down to none."""
        chain = [matched]
        while chain[-1]:
            chain.append(self._token_borders[chain[-1]])
        return chain

    def _moves(self, seen: int) -> dict[int, int | None]:
        """Tokens behind which the text ends with a part of the stop: how much; None for the whole stop."""
        if self._apart:
            return {}
        if seen not in self._seen:
            stop, borders = self._text, self._borders
            begins, border = {stop[0], stop[seen]}, seen
            while border:
                border = borders[border]
                begins.add(stop[border])
            moves: dict[int, int | None] = {}
            for token, text in self.alphabet.texts.items():
                if stop[0] not in text and text[:1] not in begins:
                    continue
                now: int | None = seen
                for character in text:
                    now = _next(stop, borders, now or 0, character)
                    if now == len(stop):
                        now = None
                        break
                if now != 0:
                    moves[token] = now
            self._seen[seen] = moves
        return self._seen[seen]


def shortest_spelling(text: str, spellings: Mapping[str, int]) -> tuple[int, ...] | None:
    """The fewest tokens that spell ``text``, of tokens by what they spell; None where none do."""
    longest = max(map(len, spellings), default=0)
    # For each end the last token of the shortest spelling up to there, and how many tokens it takes.
    best: list[tuple[int, int, int] | None] = [(0, 0, -1)]
    for end in range(1, len(text) + 1):
        ways = []
        for start in range(max(0, end - longest), end):
            before, token = best[start], spellings.get(text[start:end])
            if before is not None and token is not None:
                ways.append((before[0] + 1, start, token))
        best.append(min(ways, default=None))
    ids: list[int] = []
    place = len(text)
    while place:
        way = best[place]
        if way is None:
            return None
        _, place, token = way
        ids.append(token)
    return tuple(reversed(ids))


def _borders(pattern: Sequence[object]) -> list[int]:
    """For each length, that of the longest proper beginning that is an end too (Knuth, Morris, Pratt)."""
    borders = [0, 0]
    for place in range(1, len(pattern)):
        borders.append(_next(pattern, borders, borders[place], pattern[place]))
    return borders


def _next(pattern: Sequence[object], borders: Sequence[int], matched: int, symbol: object) -> int:
    """How much of ``pattern`` is matched behind ``symbol``, where ``matched`` of it was before."""
    while matched and pattern[matched] != symbol:
        matched = borders[matched]
    return matched + (pattern[matched] == symbol)
