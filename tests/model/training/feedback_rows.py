"""Answers with feedback, as `looktwice failures` writes them."""

from __future__ import annotations

from looktwice.model.driving.feedback_store import FeedbackRow
from tests.model.driving.test_thoughts import SOME

EIGHT = [[4.0 * step, 0.5, 0.02] for step in range(1, 9)]
SECTIONS = "<feedback>\n**1. Meta action analysis:** It\u2019s too fast.\n</feedback>"


def feedback_row(scene_id: str, *, correct: bool = False, think: str | None = str(SOME)) -> FeedbackRow:
    return FeedbackRow(
        scene_id=scene_id,
        draw=1,
        plan=None,
        think=think,
        trajectory=EIGHT,
        version="v1.1",
        score=0.9 if correct else 0.1,
        is_partial=False,
        threshold=0.8,
        correct=correct,
        feedback="The driving score is 0.9." if correct else SECTIONS,
        facts="[]",
        model="nano",
        model_revision="r",
        teacher="rules",
        teacher_revision="1",
        attempts=0,
        key="key",
        written_at="now",
    )
