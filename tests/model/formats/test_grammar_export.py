from __future__ import annotations

from typing import ClassVar

import llguidance
import llguidance.numpy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from looktwice.model.driving.plan import WORDS
from looktwice.model.families.cf_vla import CF_VLA
from looktwice.model.families.cf_vla.traj_only import TRAJ_ONLY
from looktwice.model.formats.contents import narrowing_sections
from looktwice.model.formats.cursor import AtChoice, CompiledFormat, Cursor
from looktwice.model.formats.grammar_export import to_lark
from looktwice.model.formats.pieces import Values
from looktwice.model.formats.plan_tracks import TrackWord
from tests.model.formats.phrases import PHRASES
from tests.model.formats.strategies import VOCABULARY, cf_vla_values, compiled_formats
from tests.model.formats.test_laws import walk
from tests.model.formats.vocabulary import SPECIAL

COMPILED = CompiledFormat(CF_VLA.format, VOCABULARY)
FORMATS = {family.name: family.format for family in (CF_VLA, TRAJ_ONLY)}
PHRASED = CompiledFormat(PHRASES, VOCABULARY)


class _Tokenizer:
    """The test vocabulary as llguidance wants to see one."""

    eos_token_id = SPECIAL.index("<|endoftext|>")
    bos_token_id = None
    special_token_ids: ClassVar = list(range(VOCABULARY.special))
    tokens: ClassVar = [text.encode() for text in VOCABULARY.texts]

    def __call__(self, text: str | bytes) -> list[int]:
        return list(VOCABULARY.encode(text if isinstance(text, str) else text.decode()))


TOKENIZER = llguidance.LLTokenizer(llguidance.TokenizerWrapper(_Tokenizer()))


def matcher(cursor: Cursor) -> llguidance.LLMatcher:
    matcher = llguidance.LLMatcher(TOKENIZER, llguidance.grammar_from("lark", to_lark(cursor)))
    assert not matcher.is_error(), matcher.get_error()
    return matcher


def allowed_by(state: llguidance.LLMatcher) -> set[int]:
    bits = llguidance.numpy.allocate_token_bitmask(1, len(VOCABULARY.texts))
    llguidance.numpy.fill_next_token_bitmask(state, bits, 0)
    return set(np.flatnonzero(np.unpackbits(bits.view(np.uint8), bitorder="little")).tolist())


BASE = {name: matcher(CompiledFormat(format, VOCABULARY).start()) for name, format in FORMATS.items()}


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_it_begins_as_the_format_does(name: str) -> None:
    cursor = CompiledFormat(FORMATS[name], VOCABULARY).start()
    assert allowed_by(BASE[name].deep_copy()) == set(cursor.allowed().ids.tolist())


@settings(max_examples=20, deadline=None)
@given(cf_vla_values())
def test_it_allows_what_the_cursor_allows(values: Values) -> None:
    state, cursor = BASE["cf_vla"].deep_copy(), COMPILED.start()
    for token in COMPILED.render(values):
        mine, theirs = set(cursor.allowed().ids.tolist()), allowed_by(state)
        # A word may follow itself there, and a track may go on when the cursor has counted enough.
        assert mine <= theirs
        assert mine == theirs or cursor.section in ("plan", "revised_plan")
        assert state.consume_token(token.id)
        cursor = cursor.advance(token.id)
    assert cursor.done
    assert state.is_accepting()


@settings(max_examples=20, deadline=None)
@given(cf_vla_values(), st.integers(0, 400))
def test_it_goes_on_from_any_cursor(values: Values, place: int) -> None:
    tokens = [token.id for token in COMPILED.render(values)]
    place %= len(tokens)
    cursor = COMPILED.start()
    for token in tokens[:place]:
        cursor = cursor.advance(token)
    state = matcher(cursor)
    # The very next token is the cursor's choice alone, however its grammar goes on.
    assert allowed_by(state) == set(cursor.allowed().ids.tolist())
    assert state.validate_tokens(tokens[place:]) == len(tokens) - place


def test_it_refuses_a_gap() -> None:
    text = "Meta Actions:\n- longitudinal\n  - 0.0s-0.9s: Keep Speed\n  - 1.0s-"
    tokens = list(VOCABULARY.encode(text))
    accepted = BASE["cf_vla"].deep_copy().validate_tokens(tokens)
    assert VOCABULARY.decode(tokens[:accepted]).endswith("Keep Speed\n  - ")


PLAN_WORDS = {f" {word}" for words in WORDS.values() for word in words}


def in_plan(cursor: Cursor) -> bool:
    """Whether the cursor chooses a time or a word of a plan, of which the grammar allows more."""
    if not isinstance(cursor.active, AtChoice):
        return False
    options = cursor.active.choice.options
    return all(isinstance(option.then, TrackWord) or option.text in PLAN_WORDS for option in options)


@settings(max_examples=30, deadline=None)
@given(st.one_of(compiled_formats(), st.just(PHRASED)), st.integers(0, 2**32 - 1))
def test_it_allows_what_the_cursor_allows_in_any_format(compiled: CompiledFormat, seed: int) -> None:
    cursor = compiled.start()
    state = matcher(cursor)
    narrowed = bool(narrowing_sections(compiled.format.body))
    for token in walk(cursor, seed):
        mine, theirs = set(cursor.allowed().ids.tolist()), allowed_by(state)
        assert mine == theirs or (mine <= theirs and (narrowed or in_plan(cursor)))
        assert state.consume_token(token.id)
        cursor = cursor.advance(token.id)
    assert state.is_accepting()


@settings(max_examples=30, deadline=None)
@given(compiled_formats(), st.integers(0, 2**32 - 1), st.integers(0, 400))
def test_it_goes_on_from_any_cursor_of_any_format(compiled: CompiledFormat, seed: int, place: int) -> None:
    tokens = [token.id for token in walk(compiled.start(), seed)]
    place %= len(tokens)
    cursor = compiled.start()
    for token in tokens[:place]:
        cursor = cursor.advance(token)
    state = matcher(cursor)
    assert allowed_by(state) == set(cursor.allowed().ids.tolist())
    assert state.validate_tokens(tokens[place:]) == len(tokens) - place
