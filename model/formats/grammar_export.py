"""What may follow a cursor as a Lark grammar over token ids, for guided decoding by llguidance and vLLM.

Every token is named by its id (``<[17]>``), so text is split into tokens as in training. Equal parts are
written once, as rules of their own: such engines compile a grammar anew for every request. Two things that
would make it many times as long are left out: a track's meta-actions are not counted, and a word may
follow itself. Whoever decodes with it walks a `Cursor` along and takes over where that refuses a token.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from model.formats.cursor import AtChoice, AtCode, Cursor, InText, Run
from model.formats.pieces import (
    MAX_SEGMENTS,
    Choice,
    Codes,
    FreeText,
    Literal,
    Option,
    Piece,
    PlanTracks,
    Section,
    Sequence,
    Track,
    TrackWord,
)
from model.formats.trie import Node


def to_lark(cursor: Cursor) -> str:
    """The grammar of all that may follow ``cursor``; ``start`` is the start rule."""
    return _Exporter(cursor).grammar()


class _Exporter:
    def __init__(self, cursor: Cursor) -> None:
        self._cursor, self._compiled = cursor, cursor.compiled
        self._rules: dict[str, str] = {}
        self._names: dict[str | Piece, str] = {}
        self._open: list[tuple[str, Piece]] = []  # tracks with a name, but no rule yet

    def grammar(self) -> str:
        parts, rest = [self._active()], self._cursor.rest
        while rest is not None:
            piece, _, rest = rest
            parts.append(self._of(piece))
        while self._open:
            name, piece = self._open.pop()
            self._rules[name] = self._of(piece)
        rules = [f"start: {_join(parts)}", *(f"{name}: {body}" for name, body in self._rules.items())]
        return "\n".join(rules) + "\n"

    def _active(self) -> str:
        """What is left of the piece that the cursor stands in."""
        match self._cursor.active:
            case Run(ids, position):
                return self._tokens(ids[position:])
            case AtChoice(choice, node):
                return self._choice(choice.options, node)
            case InText(piece, used):
                return self._text(piece, used)
            case AtCode(piece, stage):
                return self._codes(range(stage, piece.count))
            case None:
                return ""

    def _of(self, piece: Piece) -> str:
        match piece:
            case Literal(text):
                return self._tokens(self._compiled.literal(text))
            case Sequence(parts):
                return _join(map(self._of, parts))
            case Section(_, body):
                return self._of(body)
            case PlanTracks():
                return self._of(piece.expand())
            case Track() | TrackWord():
                return self._track(replace(piece, segments_left=MAX_SEGMENTS, previous=None))
            case Choice(options):
                return self._choice(options, self._compiled.trie(piece))
            case FreeText():
                return self._text(piece, 0)
            case Codes(count):
                return self._codes(range(count))

    def _track(self, piece: Track | TrackWord) -> str:
        if piece not in self._names:
            name = self._names[piece] = f"track_{len(self._names)}"
            self._open.append((name, piece.expand()))
        return self._names[piece]

    def _choice(self, options: tuple[Option, ...], node: Node) -> str:
        """The options below a node of the trie; what follows all of them alike is written once."""
        after = {self._of(options[position].then) for position in node.options()}
        if len(after) == 1:
            return _join((self._alternatives(node, [""] * len(options)), *after))
        return self._alternatives(node, [self._of(option.then) for option in options])

    def _alternatives(self, node: Node, after: list[str]) -> str:
        """The words below a node, each followed by what comes ``after`` its option."""
        if node.option is not None:
            return after[node.option]
        parts = [
            _join((_id(token), self._alternatives(child, after))) for token, child in node.children.items()
        ]
        return parts[0] if len(parts) == 1 else self._named(" | ".join(parts))

    def _text(self, piece: FreeText, used: int) -> str:
        stop = self._tokens(self._compiled.literal(piece.stop))
        word = self._named(_ranges(map(int, self._compiled.free_ids(piece.stop, may_stop=False))))
        left = piece.max_tokens - used
        return _join((f"{word}{{{0 if used else 1},{left}}}" if left else "", stop))

    def _codes(self, stages: range) -> str:
        return _join(_ranges(map(int, self._compiled.codes(stage))) for stage in stages)

    def _tokens(self, ids: tuple[int, ...]) -> str:
        tokens = _join(map(_id, ids))
        return self._named(tokens) if len(ids) > 1 else tokens

    def _named(self, body: str) -> str:
        """A rule for ``body``; the same one whenever it comes again."""
        if body not in self._names:
            name = self._names[body] = f"part_{len(self._names)}"
            self._rules[name] = body
        return self._names[body]


def _join(parts: Iterable[str]) -> str:
    return " ".join(filter(None, parts))


def _id(token: int) -> str:
    return f"<[{token}]>"


def _ranges(ids: Iterable[int]) -> str:
    """Any one of ascending ids."""
    runs: list[list[int]] = []
    for token in ids:
        if runs and token == runs[-1][1] + 1:
            runs[-1][1] = token
        else:
            runs.append([token, token])
    return f"<[{','.join(f'{first}-{last}' for first, last in runs)}]>"
