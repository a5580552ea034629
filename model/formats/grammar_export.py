"""What may follow a cursor as a Lark grammar over token ids, for guided decoding by llguidance and vLLM.

Every token is named by its id (``<[17]>``), so text is split into tokens as in training. Equal parts are
written once, as rules of their own: such engines compile a grammar anew for every request. The grammar says
what the cursor allows, but for what would make it many times as long: it does not
count a track's meta-actions, a word may follow itself, and what is written narrows nothing that comes behind
it. Whoever decodes with it walks a `Cursor` along and takes over where that refuses a token.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from looktwice.model.formats.cursor import Active, AtChoice, AtCode, AtFork, Cursor, ForcedRun, InText, Rest
from looktwice.model.formats.free_text import BEGUN, TextState
from looktwice.model.formats.pieces import (
    Choice,
    Codes,
    FreeText,
    Literal,
    Maybe,
    Option,
    Piece,
    Section,
    Sequence,
    Shorthand,
)
from looktwice.model.formats.plan_tracks import MAX_SEGMENTS, TrackRest, TrackWord
from looktwice.model.formats.trie import Node


def to_lark(cursor: Cursor) -> str:
    """The grammar of all that may follow ``cursor``; ``start`` is the start rule."""
    return _Exporter(cursor).grammar()


class _Exporter:
    def __init__(self, cursor: Cursor) -> None:
        self._cursor, self._compiled = cursor, cursor.compiled
        self._rules: dict[str, str] = {}
        self._shorthands: dict[Shorthand, str] = {}
        self._names: dict[str | Piece | tuple[FreeText, TextState], str] = {}
        self._open: list[tuple[str, Piece | tuple[FreeText, TextState]]] = []  # with a name, but no rule yet

    def grammar(self) -> str:
        start = self._from(self._cursor.active, self._cursor.rest)
        while self._open:
            name, what = self._open.pop()
            self._rules[name] = self._text_rule(*what) if isinstance(what, tuple) else self._of(what)
        rules = [f"start: {start}", *(f"{name}: {body}" for name, body in self._rules.items())]
        return "\n".join(rules) + "\n"

    def _from(self, active: Active | None, rest: Rest) -> str:
        """What is left of the piece that the cursor stands in, and what comes behind it."""
        if isinstance(active, AtFork):
            return self._named(" | ".join(self._from(*way) for way in active.ways))
        parts = [self._active(active)]
        while rest is not None:
            piece, _, rest = rest
            parts.append(self._of(piece))
        return _join(parts)

    def _active(self, active: Active | None) -> str:
        match active:
            case ForcedRun(ids, position):
                return self._tokens(ids[position:])
            case AtChoice(choice, node):
                # An option that may end at this node is another of the cursor's ways.
                return self._choice(choice.options, node, ends=False)
            case InText(piece, state):
                return self._text(piece, state)
            case AtCode(piece, place):
                return self._codes(piece, range(place, piece.count))
            case _:
                return ""

    def _of(self, piece: Piece) -> str:
        match piece:
            case Literal(text):
                return self._tokens(self._compiled.literal(text))
            case Sequence(parts):
                return _join(map(self._of, parts))
            case Section(_, body):
                return self._of(body)
            case Choice(options):
                return self._choice(options, self._compiled.trie(piece), ends=True)
            case Maybe(inner):
                return f"{self._named(self._of(inner))}?"
            case FreeText():
                return self._text(piece, BEGUN)
            case Codes(_, count):
                return self._codes(piece, range(count))
            case TrackRest() | TrackWord():
                free = replace(piece, segments_left=MAX_SEGMENTS, previous=None, aim=None)
                return self._later(replace(free, start=0) if isinstance(free, TrackWord) else free)
            case Shorthand():
                if piece not in self._shorthands:
                    text = self._of(self._compiled.expanded(piece))
                    self._shorthands[piece] = text and self._named(text)
                return self._shorthands[piece]

    def _later(self, piece: TrackRest | TrackWord) -> str:
        if piece not in self._names:
            name = self._names[piece] = f"track_{len(self._names)}"
            self._open.append((name, piece.expand()))
        return self._names[piece]

    def _choice(self, options: tuple[Option, ...], node: Node, *, ends: bool) -> str:
        """The options below a node of the trie; what follows all of them alike is written once."""
        behind = {position for position in node.options() if ends or position != node.option}
        after = {self._of(options[position].then) for position in behind}
        if len(after) == 1:
            return _join((self._alternatives(node, [""] * len(options), ends=ends), *after))
        return self._alternatives(node, [self._of(option.then) for option in options], ends=ends)

    def _alternatives(self, node: Node, after: list[str], *, ends: bool = True) -> str:
        """The words below a node, each followed by what comes ``after`` its option."""
        if not node.children:
            return after[node.option] if node.option is not None else ""
        parts = [
            _join((_id(token), self._alternatives(child, after))) for token, child in node.children.items()
        ]
        shorter = after[node.option] if ends and node.option is not None else None
        if shorter:
            parts.append(shorter)
        words = parts[0] if len(parts) == 1 else self._named(" | ".join(parts))
        return f"{self._named(words)}?" if shorter == "" else words

    def _text(self, piece: FreeText, state: TextState) -> str:
        rules = self._compiled.text(piece)
        if not rules.apart:
            return self._text_name(piece, state)
        words = _ranges(rules.allowed(BEGUN).tolist())
        left = piece.max_tokens - state.used
        text = f"{self._named(words)}{{{0 if state.used else 1},{left}}}" if left else ""
        return _join((text, self._tokens(rules.stop)))

    def _text_name(self, piece: FreeText, state: TextState) -> str:
        """The rule for what is left of a text from a state on."""
        key = (piece, state)
        if key not in self._names:
            name = self._names[key] = f"text_{len(self._names)}"
            self._open.append((name, key))
        return self._names[key]

    def _text_rule(self, piece: FreeText, state: TextState) -> str:
        rules = self._compiled.text(piece)
        parts = []
        for then, ids in rules.groups(state).items():
            if then.matched < rules.end:
                behind = self._text_name(piece, then)
            else:
                behind = self._tokens(rules.stop[rules.end :])
            parts.append(_join((self._named(_ranges(ids.tolist())), behind)))
        return " | ".join(parts)

    def _codes(self, piece: Codes, places: range) -> str:
        return _join(_ranges(self._compiled.codes(piece, place).tolist()) for place in places)

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
