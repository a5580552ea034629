from __future__ import annotations

from typing import ClassVar

import llguidance
import pytest
from hypothesis import given, settings

from model.formats.cf_vla import CF_VLA, FORMATS
from model.formats.cursor import CompiledFormat
from model.formats.grammar_export import to_lark
from model.formats.pieces import Values
from tests.model.formats.strategies import cf_vla_values
from tests.model.formats.vocabulary import SPECIAL, ByteVocabulary

VOCABULARY = ByteVocabulary()
COMPILED = CompiledFormat(CF_VLA, VOCABULARY)


class _Tokenizer:
    """The test vocabulary as llguidance wants to see one."""

    eos_token_id = SPECIAL.index("<|endoftext|>")
    bos_token_id = None
    special_token_ids: ClassVar = list(range(len(SPECIAL) + 6 * VOCABULARY.size))
    tokens: ClassVar = [text.encode() for text in VOCABULARY.texts]

    def __call__(self, text: str | bytes) -> list[int]:
        return list(VOCABULARY.encode(text if isinstance(text, str) else text.decode()))


def matcher(format_name: str) -> llguidance.LLMatcher:
    tokenizer = llguidance.LLTokenizer(llguidance.TokenizerWrapper(_Tokenizer()))
    grammar = to_lark(FORMATS[format_name], VOCABULARY)
    matcher = llguidance.LLMatcher(tokenizer, llguidance.grammar_from("lark", grammar))
    assert not matcher.is_error(), matcher.get_error()
    return matcher


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_grammars_are_valid(name: str) -> None:
    matcher(name)


BASE = matcher("cf_vla")


@settings(max_examples=20, deadline=None)
@given(cf_vla_values())
def test_the_grammar_accepts_what_training_writes(values: Values) -> None:
    tokens = [token.id for token in COMPILED.render(values)]
    state = BASE.deep_copy()
    assert state.validate_tokens(tokens) == len(tokens)


def test_the_grammar_refuses_a_gap() -> None:
    text = "Meta Actions:\n- longitudinal\n  - 0.0s-0.9s: Keep Speed\n  - 1.0s-"
    tokens = list(VOCABULARY.encode(text))
    accepted = BASE.deep_copy().validate_tokens(tokens)
    assert VOCABULARY.decode(tokens[:accepted]).endswith("Keep Speed\n  - ")
