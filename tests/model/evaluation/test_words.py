from __future__ import annotations

from hypothesis import given

from looktwice.model.driving.phrases import Facts
from looktwice.model.evaluation.words import unknown_words, words_of
from tests.model.driving.strategies import facts


def test_misspelt_words_are_none() -> None:
    assert unknown_words("A M wouldoldunleff stands in my lane, some 25 metres ahead.") == [
        "m",
        "wouldoldunleff",
    ]


def test_numbers_and_times_are_no_words() -> None:
    assert words_of("Turning from 0.9s, some 25 m/s; it's the T-junction.") == [
        *("turning", "from", "some", "m", "s", "it's", "the", "t-junction")
    ]


@given(facts())
def test_every_word_of_a_reflection_in_phrases_is_one(facts: Facts) -> None:
    assert unknown_words(str(facts)) == []
