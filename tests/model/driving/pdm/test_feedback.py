"""Feedback as text, both ways."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.pdm.feedback import (
    BEGIN,
    END,
    MOST_CHARACTERS,
    SECTIONS,
    Feedback,
    FeedbackError,
    RuleFeedback,
    parse_feedback,
)

PAPER = """- 1. Meta action Analysis: The predicted meta action in the <think> block matches the Ground Truth.
- **2. Think Process Analysis:** Overlooking key obstacle contributes directly to the failure... The car
should pay more attention to a vehicle located 18.23 meters ahead of ego vehicle and 6.31 meters to the right.
- **3. Safety Failure:** The safety failure is due to the NC=0 score, indicating a collision.
- **4. Efficiency Failure:** The TTC score is 0, showing an unsafe following distance.
- **5. Actionable Correction:** Adjust the steering angle. Maintain a speed of approximately 5 m/s.
"""


WORDS = st.text(st.characters(exclude_categories=("C", "Z")), min_size=1, max_size=20)


def is_a_paragraph(text: str) -> bool:
    try:
        Feedback(text, *["x"] * 4)
    except FeedbackError:
        return False
    return True


PARAGRAPHS = st.lists(WORDS, min_size=1, max_size=40).map(" ".join).filter(is_a_paragraph)
FIVE = st.builds(Feedback, *[PARAGRAPHS] * 5)
VERDICTS = st.builds(RuleFeedback, st.floats(0, 1), correct=st.booleans())


@given(FIVE | VERDICTS)
def test_the_text_of_feedback_reads_as_that_feedback(feedback: Feedback | RuleFeedback) -> None:
    assert parse_feedback(str(feedback)) == feedback


@given(FIVE)
def test_what_was_read_without_tags_and_in_another_spelling_is_written_in_ours(feedback: Feedback) -> None:
    bare = str(feedback).replace(BEGIN, "").replace(END, "")
    for heading in SECTIONS.values():
        bare = bare.replace(f"{heading}:**", f"{heading.upper()}:**\n")
    assert str(parse_feedback(bare)) == str(feedback)


@given(st.text())
def test_any_other_text_is_an_error_of_its_own(text: str) -> None:
    with pytest.raises(FeedbackError):
        parse_feedback(text)


def test_the_papers_example_is_read() -> None:
    found = parse_feedback(PAPER)
    assert isinstance(found, Feedback)
    assert found.think_process.endswith("18.23 meters ahead of ego vehicle and 6.31 meters to the right.")
    assert found.meta_action.endswith("block matches the Ground Truth.")


def test_the_verdict_is_the_papers_word_for_word() -> None:
    assert str(RuleFeedback(0.0, correct=False)) == (
        "The driving score is 0.0. The score is below the threshold, and the result is wrong. Please follow "
        "the prompts to regenerate the correct trajectory."
    )
    assert "is 0.7983." in str(RuleFeedback(0.79833, correct=False))
    assert "is 1.0." in str(RuleFeedback(1.0, correct=True))
    assert "is right" in str(RuleFeedback(0.8, correct=True))


GOOD = str(Feedback("a", "b", "c", "d", "e"))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "1. Meta action analysis"),
        (GOOD.replace("**4.", "**5."), "4. Efficiency failure"),
        (GOOD.replace("**3. Safety failure:** c\n", ""), "3. Safety failure"),
        (GOOD.replace("** d\n", "**\n"), "'Efficiency failure' is empty"),
        (GOOD.replace(END, "**5. Actionable correction:** f\n" + END), "behind the five"),
        ("Sure! " + GOOD, "nothing before"),
        (GOOD + BEGIN, "one <feedback>"),
        (GOOD.replace("** a", "** " + "a" * (MOST_CHARACTERS + 1)), "are enough"),
        (str(RuleFeedback(0.5, correct=False)) + " Really.", "a verdict reads"),
    ],
)
def test_what_is_wrong_is_told(text: str, told: str) -> None:
    with pytest.raises(FeedbackError, match=told.replace("(", r"\(")):
        parse_feedback(text)


def test_a_score_beyond_its_range_is_none() -> None:
    for score in (-0.1, 1.1, float("nan")):
        with pytest.raises(FeedbackError):
            RuleFeedback(score, correct=False)
