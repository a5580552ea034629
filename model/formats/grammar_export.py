"""A response format as a Lark grammar for guided decoding elsewhere (llguidance, vLLM).

The grammar is right-linear within a plan: one rule per group and start time, so only partitions of the
horizon can be written. It works on text and on the vocabulary's special tokens; unlike our own cursor it
does not count a track's meta-actions, lets a word follow itself and does not fix how text is split into
tokens.
"""

from __future__ import annotations

import json
import re

from model.driving.plan import TICKS, WORDS, Group, format_tick
from model.formats.cursor import Vocabulary
from model.formats.pieces import (
    Choice,
    Codes,
    Format,
    FreeText,
    Literal,
    Piece,
    PlanTracks,
    Section,
    Sequence,
    Track,
    TrackWord,
)

_SPECIAL = re.compile(r"(<\|[a-z_]+\|>)")


def to_lark(format: Format, vocabulary: Vocabulary) -> str:
    """The grammar's text; ``start`` is the start rule, codes are token ranges like ``<[420-675]>``."""
    rules: dict[str, str] = {}
    start = _rule(format.body, vocabulary, rules)
    lines = [f"start: {start}"] + [f"{name}: {body}" for name, body in rules.items()]
    return "\n".join(lines) + "\n"


def _rule(piece: Piece, vocabulary: Vocabulary, rules: dict[str, str]) -> str:
    match piece:
        case Literal(text):
            return _literal(text)
        case Sequence(parts):
            return " ".join(_rule(part, vocabulary, rules) for part in parts)
        case Section(_, body):
            return _rule(body, vocabulary, rules)
        case Choice(options):
            alternatives = [
                f"{_literal(option.text)} {_rule(option.then, vocabulary, rules)}" for option in options
            ]
            return f"({' | '.join(alternatives)})"
        case PlanTracks(groups):
            parts_text = []
            for group in groups:
                _add_track_rules(group, rules)
                parts_text += [_literal(f"- {group}\n"), _track_name(group, 0)]
            return " ".join(parts_text)
        case FreeText(stop, max_tokens):
            # A character bound, as grammars count characters: tokens hold at least one each.
            return f"/[^\\n]{{1,{6 * max_tokens}}}/ {_literal(stop)}"
        case Codes(count):
            ranges = [vocabulary.code_ids(stage) for stage in range(count)]
            return " ".join(f"<[{ids.start}-{ids.stop - 1}]>" for ids in ranges)
        case Track() | TrackWord():
            raise TypeError("a track is exported as part of its plan")


def _literal(text: str) -> str:
    """Quoted text, with special tokens left bare as the grammar's token references."""
    parts = [part for part in _SPECIAL.split(text) if part]
    return " ".join(part if _SPECIAL.fullmatch(part) else json.dumps(part) for part in parts)


def _track_name(group: Group, start: int) -> str:
    return f"{group}_{start}"


def _add_track_rules(group: Group, rules: dict[str, str]) -> None:
    words = " | ".join(json.dumps(f" {word}\n") for word in WORDS[group])
    rules[f"{group}_word"] = words
    for start in range(TICKS):
        bullet = json.dumps(f"  - {format_tick(start)}s-")
        ends = [
            f'"{format_tick(end)}s:" {group}_word {_track_name(group, end)}'
            for end in range(start + 1, TICKS)
        ]
        ends.append(f'"{format_tick(TICKS)}s:" {group}_word')
        rules[_track_name(group, start)] = f"{bullet} ({' | '.join(ends)})"
