"""What holds for every format: values, text, tokens and grammar say the same."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from looktwice.model.formats.contents import number_alphabets
from looktwice.model.formats.cursor import AtCode, CompiledFormat, Cursor, Token
from looktwice.model.formats.pieces import FormatError
from looktwice.model.formats.text import parse, parse_beginning
from tests.model.formats.strategies import VOCABULARY, compiled_formats, values_of


def walk(cursor: Cursor, seed: int) -> list[Token]:
    """A response written by uniform random choices."""
    random = np.random.default_rng(seed)
    written: list[Token] = []
    while True:
        forced, cursor = cursor.forced()
        written += forced
        if cursor.done:
            return written
        ids = cursor.allowed().ids
        assert len(ids) > 1
        assert (np.diff(ids) > 0).all()
        token = int(random.choice(ids))
        written.append(Token(token, cursor.section))
        cursor = cursor.advance(token)


def ids_of(tokens: list[Token]) -> list[int]:
    return [token.id for token in tokens]


def assert_writable(compiled: CompiledFormat, tokens: list[Token]) -> None:
    """The cursor writes these tokens, in these sections, and is done behind them."""
    cursor = compiled.start()
    for token in tokens:
        assert token.id in cursor.allowed().ids
        assert token.section == cursor.section
        cursor = cursor.advance(token.id)
    assert cursor.done


@given(st.data(), compiled_formats())
def test_what_is_rendered_parses_to_the_same_values(data: st.DataObject, compiled: CompiledFormat) -> None:
    values = data.draw(values_of(compiled))
    tokens = compiled.render(values)
    assert parse(compiled, VOCABULARY.decode(ids_of(tokens))) == values
    assert len(tokens) <= compiled.longest()


@given(st.data(), compiled_formats())
def test_what_is_rendered_can_be_written_by_the_cursor(data: st.DataObject, compiled: CompiledFormat) -> None:
    assert_writable(compiled, compiled.render(data.draw(values_of(compiled))))


@given(st.data(), compiled_formats())
def test_what_is_decided_is_forced_and_the_rest_is_not(data: st.DataObject, compiled: CompiledFormat) -> None:
    values = data.draw(values_of(compiled))
    section = data.draw(st.sampled_from([*values, "nowhere"]))
    count = data.draw(st.integers(0, len(values.all(section))))
    try:
        cursor = compiled.start(fixed={section: values.all(section)[:count]})
    except FormatError:
        # In free words nothing can be decided, nor in sections that stand in several places.
        assume(False)
    plain = compiled.start()
    for token in compiled.render(values):
        allowed, before = cursor.allowed().ids, plain.allowed().ids
        assert token.id in allowed
        assert set(allowed) <= set(before)
        if token.section == section and count == len(values.all(section)):
            assert len(allowed) == 1
        cursor, plain = cursor.advance(token.id), plain.advance(token.id)
    assert cursor.done


@given(compiled_formats(), st.integers(0, 2**32 - 1))
def test_a_finished_section_says_what_it_says_in_the_end(compiled: CompiledFormat, seed: int) -> None:
    tokens = walk(compiled.start(), seed)
    whole = parse(compiled, VOCABULARY.decode(ids_of(tokens)))
    for place in range(1, len(tokens) + 1):
        section = tokens[place - 1].section
        if section not in {token.section for token in tokens[place:]}:
            beginning = parse_beginning(compiled, VOCABULARY.decode(ids_of(tokens[:place])))
            assert beginning.all(section) == whole.all(section)


@given(compiled_formats(), st.integers(0, 2**32 - 1))
def test_what_the_cursor_writes_parses_and_renders_to_the_same_text(
    compiled: CompiledFormat, seed: int
) -> None:
    tokens = walk(compiled.start(), seed)
    assert len(tokens) <= compiled.longest()
    text = VOCABULARY.decode(ids_of(tokens))
    # The tokenizer may spell free text with other tokens; the text is the same.
    assert VOCABULARY.decode(ids_of(compiled.render(parse(compiled, text)))) == text


@given(compiled_formats(), st.integers(0, 2**32 - 1))
def test_the_alphabets_of_codes_that_are_written_are_told(compiled: CompiledFormat, seed: int) -> None:
    told, cursor = number_alphabets(compiled.format.body), compiled.start()
    for token in walk(cursor, seed):
        if isinstance(cursor.active, AtCode) and cursor.active.piece.size is not None:
            assert told[cursor.active.piece.alphabet] == cursor.active.piece.size
        cursor = cursor.advance(token.id)


@given(st.data(), compiled_formats(), st.integers(0, 2**32 - 1))
def test_a_changed_text_parses_only_if_the_cursor_can_write_it(
    data: st.DataObject, compiled: CompiledFormat, seed: int
) -> None:
    ids = ids_of(walk(compiled.start(), seed))
    text = VOCABULARY.decode(ids)
    if data.draw(st.booleans()):
        place = data.draw(st.integers(0, len(text)))
        cut = data.draw(st.integers(0, 3))
        put = ["", "a", "b", "<", "1", "\n", ",", "-", " ", text[place : place + 9]]
        changed = text[:place] + data.draw(st.sampled_from(put)) + text[place + cut :]
    else:
        # The next token of the vocabulary is the next code, or the next letter.
        place = data.draw(st.integers(0, len(ids) - 1))
        other = min(ids[place] + 1, len(VOCABULARY) - 1)
        changed = VOCABULARY.decode([*ids[:place], other, *ids[place + 1 :]])
    try:
        values = parse(compiled, changed)
    except FormatError:
        assert not can_write(compiled, changed)
        return
    tokens = compiled.render(values)
    assert VOCABULARY.decode(ids_of(tokens)) == changed
    cursor = compiled.start()
    for token in tokens:
        cursor = cursor.advance(token.id)
    assert cursor.done


def can_write(compiled: CompiledFormat, text: str, texts: Sequence[str] = VOCABULARY.texts) -> bool:
    """Whether any tokens that the cursor allows spell ``text``; ``texts`` are those of the tokens."""
    # Tokens of one text lead to few different states; those that failed are not tried again.
    failed: set[tuple[int, object, object]] = set()

    def from_(cursor: Cursor, place: int) -> bool:
        if cursor.done:
            return place == len(text)
        key = (place, cursor.active, cursor.rest)
        if key in failed:
            return False
        for token in cursor.allowed().ids.tolist():
            spelt = texts[token]
            if text.startswith(spelt, place) and from_(cursor.advance(token), place + len(spelt)):
                return True
        failed.add(key)
        return False

    return from_(compiled.start(), 0)
