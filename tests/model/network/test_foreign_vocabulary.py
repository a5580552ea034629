"""What holds for formats over the tokenizers of foreign checkpoints."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.families.elf_vla import ELF_VLA
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.formats.pieces import FormatError
from looktwice.model.formats.text import parse
from looktwice.model.network.foreign_vocabulary import ForeignVocabulary
from looktwice.model.network.vocabulary import VocabularyError
from tests.foreign import END, IMAGE, byte_level_tokenizer, sentencepiece_tokenizer, wordpiece_tokenizer
from tests.model.formats.strategies import compiled_formats, values_of
from tests.model.formats.test_laws import assert_writable, can_write, ids_of, walk

VOCABULARIES = {
    "byte-level": ForeignVocabulary(byte_level_tokenizer()),
    "sentencepiece": ForeignVocabulary(sentencepiece_tokenizer()),
}
kinds = st.sampled_from(list(VOCABULARIES))


@given(kinds, st.text())
def test_tokens_spell_what_they_are_made_of(kind: str, text: str) -> None:
    vocabulary = VOCABULARIES[kind]
    assert vocabulary.decode(vocabulary.encode(text)) == text


@given(
    kinds,
    st.lists(st.sampled_from(["Keep", " Keep", " [", "[", " ", "\n", "12", "a", "\u00e4", END]), max_size=9),
)
def test_pieces_that_are_encoded_apart_join_to_their_text(kind: str, pieces: list[str]) -> None:
    vocabulary = VOCABULARIES[kind]
    ids = [token for piece in pieces for token in vocabulary.encode(piece)]
    assert vocabulary.decode(ids) == "".join(pieces)


@pytest.mark.parametrize("kind", VOCABULARIES)
def test_the_tokenizers_own_tokens_come_first(kind: str) -> None:
    vocabulary = VOCABULARIES[kind]
    [token] = vocabulary.encode(" Keep")
    assert vocabulary.decode([token]) == " Keep"
    [end] = vocabulary.encode(END)
    assert vocabulary.special == (END, IMAGE)
    assert not vocabulary.free_text_ids()[end]
    assert len(vocabulary.encode("<|im_end|>")) > 1


@pytest.mark.parametrize("kind", VOCABULARIES)
def test_free_text_is_printable(kind: str) -> None:
    vocabulary = VOCABULARIES[kind]
    for multiline in (False, True):
        mask = vocabulary.free_text_ids(multiline=multiline)
        assert mask.shape == (len(vocabulary),)
        texts = [vocabulary.decode([token]) for token in np.flatnonzero(mask).tolist()]
        assert {"a", " ", " Keep"} <= {*texts}
        assert ("\n" in texts) == multiline
        assert all(text and text.replace("\n", "").isprintable() and "\ufffd" not in text for text in texts)


@given(st.data(), kinds)
def test_what_is_rendered_parses_and_can_be_written(data: st.DataObject, kind: str) -> None:
    vocabulary = VOCABULARIES[kind]
    compiled = data.draw(compiled_formats(vocabulary))
    values = data.draw(values_of(compiled))
    tokens = compiled.render(values)
    assert parse(compiled, vocabulary.decode(ids_of(tokens))) == values
    assert_writable(compiled, tokens)


@given(st.data(), kinds, st.integers(0, 2**32 - 1))
def test_a_changed_text_parses_only_if_the_cursor_can_write_it(
    data: st.DataObject, kind: str, seed: int
) -> None:
    vocabulary = VOCABULARIES[kind]
    compiled = data.draw(compiled_formats(vocabulary))
    text = vocabulary.decode(ids_of(walk(compiled.start(), seed)))
    assert vocabulary.decode(ids_of(compiled.render(parse(compiled, text)))) == text
    place, cut = data.draw(st.integers(0, len(text))), data.draw(st.integers(0, 3))
    changed = text[:place] + data.draw(st.sampled_from(["", "a", "<", "1", "\n", " "])) + text[place + cut :]
    texts = [vocabulary.decode([token]) for token in range(len(vocabulary))]
    try:
        values = parse(compiled, changed)
    except FormatError:
        assert not can_write(compiled, changed, texts)
        return
    assert vocabulary.decode(ids_of(compiled.render(values))) == changed


@given(kinds, st.integers(0, 2**32 - 1))
def test_poses_in_digits_are_read_as_they_were_written(kind: str, seed: int) -> None:
    vocabulary = VOCABULARIES[kind]
    compiled = CompiledFormat(ELF_VLA.format, vocabulary)
    tokens = walk(compiled.start(), seed)
    text = vocabulary.decode(ids_of(tokens))
    values = parse(compiled, text)
    assert vocabulary.decode(ids_of(compiled.render(values))) == text


def test_tokenizers_that_do_not_spell_text_are_refused() -> None:
    with pytest.raises(VocabularyError, match="decodes by WordPiece"):
        ForeignVocabulary(wordpiece_tokenizer())
    with pytest.raises(VocabularyError, match=r"no tokenizer\.json"):
        ForeignVocabulary(object())
