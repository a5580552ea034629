from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tokenizers import Tokenizer, models
from transformers import AutoTokenizer, PreTrainedTokenizerFast

from looktwice.model.families.cf_vla import CF_VLA
from looktwice.model.families.cf_vla.corpus import random_plans
from looktwice.model.network import vocabulary as words
from looktwice.model.network.nano_corpus import driving_sentences, nano_corpus
from looktwice.model.network.vocabulary import (
    FUTURE_START,
    Vocabulary,
    VocabularyError,
    build_nano_tokenizer,
    code_token,
    expand_tokenizer,
)
from tests.model.network.conftest import CODEC_SIZE

VOCABULARY = Vocabulary(build_nano_tokenizer(nano_corpus(), CODEC_SIZE))


@given(st.text(max_size=60))
def test_any_text_comes_back(text: str) -> None:
    assert VOCABULARY.decode(VOCABULARY.encode(text)) == text


@given(st.lists(st.integers(0, CODEC_SIZE - 1), min_size=6, max_size=6))
def test_codes_come_back(codes: list[int]) -> None:
    ids = tuple(VOCABULARY.code_ids(stage)[code] for stage, code in enumerate(codes))
    text = "".join(code_token(stage, code) for stage, code in enumerate(codes))
    assert VOCABULARY.decode(ids) == text
    assert VOCABULARY.encode(text) == ids


@given(st.lists(st.sampled_from(np.flatnonzero(VOCABULARY.free_text_ids()).tolist()), max_size=30))
def test_free_text_stays_on_one_printable_line(ids: list[int]) -> None:
    text = VOCABULARY.decode(ids)
    assert text.isprintable()
    assert len(text.splitlines()) <= 1
    assert "<|traj" not in text or not set(ids) & set(VOCABULARY.encode(text)[:1])


def test_free_text_writes_english_but_no_markers(vocabulary: Vocabulary) -> None:
    mask = vocabulary.free_text_ids()
    assert mask.shape == (len(vocabulary),)
    assert all(mask[token] for token in vocabulary.encode("The lead vehicle brakes, so slow down: 12.5 m/s!"))
    for token in (*words.QWEN_TOKENS, *words.OUR_TOKENS, code_token(3, 0), "\n", "\r", "\t"):
        assert not mask[vocabulary.encode(token)[0]]


def test_numbers_are_tokens_behind_all_others() -> None:
    plain = build_nano_tokenizer(["a b"], 4, size=260)
    before = Vocabulary(plain)
    with_numbers = build_nano_tokenizer(["a b"], 4, size=260, numbers={"x_m": 21, "turn_rad": 3})
    after = Vocabulary(with_numbers)
    assert set(before.alphabets) == {"trajectory"}
    assert after.alphabets["x_m"] == (range(len(before), len(before) + 21),)
    assert after.alphabets["turn_rad"] == (range(len(before) + 21, len(before) + 24),)
    assert after.decode([len(before) + 7]) == "<|x_m_0007|>"
    assert [after.decode([id]) for id in range(len(before))] == [
        before.decode([id]) for id in range(len(before))
    ]
    assert not after.free_text_ids()[len(before) :].any()


def test_numbers_must_lie_side_by_side() -> None:
    tokenizer = build_nano_tokenizer(["a b"], 4, size=260, numbers={"x_m": 2})
    tokenizer.add_tokens(["<|other|>", "<|x_m_0002|>"])
    with pytest.raises(VocabularyError, match="the numbers of 'x_m' must be 3 tokens side by side"):
        Vocabulary(tokenizer)


def test_digits_are_single_tokens(vocabulary: Vocabulary) -> None:
    assert len(vocabulary.encode("2026")) == 4


def test_markers_are_single_tokens(vocabulary: Vocabulary) -> None:
    assert vocabulary.encode(f"\n{FUTURE_START}") == (
        vocabulary.encode("\n")[0],
        vocabulary.id_of(FUTURE_START),
    )


def test_plans_and_reasoning_are_compact(vocabulary: Vocabulary) -> None:
    sentences = list(driving_sentences(per_template=1))
    tokens = sum(len(vocabulary.encode(sentence)) for sentence in sentences)
    assert tokens / sum(len(sentence.split()) for sentence in sentences) < 1.4
    for plan in random_plans(5):
        # A segment takes bullet, two times of four characters, its words and the line's end.
        segments = sum(len(track) for _, track in plan.tracks())
        assert len(vocabulary.encode(str(plan))) <= 17 * segments + 3 * len(plan.tracks())


def test_families_bring_phrases_and_responses() -> None:
    [bare, planning] = (set(nano_corpus([name])) for name in ("traj_only", "cf_vla"))
    assert CF_VLA.corpus is not None
    assert not bare & {*CF_VLA.corpus.phrases}
    assert planning > {*CF_VLA.corpus.phrases, *CF_VLA.corpus.responses(list(driving_sentences(3)))}


def test_corpus_is_deterministic_and_varied() -> None:
    first, second = list(driving_sentences()), list(driving_sentences())
    assert first == second
    assert len(set(first)) > 500
    assert "{" not in "".join(first)


def test_saved_and_loaded_by_transformers(vocabulary: Vocabulary, tmp_path: Path) -> None:
    vocabulary.tokenizer.save_pretrained(tmp_path)
    again = Vocabulary(AutoTokenizer.from_pretrained(tmp_path))
    text = f"Keep Speed é 12{FUTURE_START}{code_token(5, 3)}\n"
    assert again.encode(text) == vocabulary.encode(text)
    assert len(again) == len(vocabulary)
    assert [again.code_ids(stage) for stage in range(6)] == [vocabulary.code_ids(stage) for stage in range(6)]


def test_missing_tokens_are_named() -> None:
    bare = PreTrainedTokenizerFast(tokenizer_object=Tokenizer(models.BPE()))  # type: ignore[no-untyped-call]
    with pytest.raises(VocabularyError, match=r"<\|im_start\|>"):
        Vocabulary(bare)
    bare.add_tokens(list(words.QWEN_TOKENS))
    bare.add_tokens(list(words.OUR_TOKENS))
    with pytest.raises(VocabularyError, match="codes"):
        Vocabulary(bare)
    assert expand_tokenizer(bare, 4) == 24 + len(words.TRACK_TOKENS)
    assert Vocabulary(bare).codec_size == 4
    with pytest.raises(VocabularyError, match="no token"):
        Vocabulary(bare).id_of("<|nothing|>")
