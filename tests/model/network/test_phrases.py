from __future__ import annotations

from looktwice.model.bundled import CHECKPOINT
from looktwice.model.driving.phrases import CONSEQUENCES, CORRECTIONS, GOING_ON, HEADS, details
from looktwice.model.network.checkpoint import read_parts

SPELT_OUT = {"The road runs straight on"}
"""Phrases that are younger than this tokenizer. Only their first token is a decision."""


def test_a_decision_of_a_reflection_is_a_token_of_the_nano_models() -> None:
    parts = read_parts(CHECKPOINT)
    assert parts.settings.reflection == "phrases"
    behind = {text for head in HEADS.values() for texts in details(head) for text in texts if text}
    texts = {*HEADS, *behind, *CONSEQUENCES, *CORRECTIONS, GOING_ON} - SPELT_OUT
    assert [text for text in texts if len(parts.vocabulary.encode(text)) > 1] == []
