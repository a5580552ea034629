"""Feedback on a plan: the verdict by rule, or a teacher's five sections; typed, and as text both ways.

Source: ELF-VLA, figures 7 and 8 and section 7.2 of its supplement.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

BEGIN: Final = "<feedback>"
END: Final = "</feedback>"
SECTIONS: Final = {
    "meta_action": "Meta action analysis",
    "think_process": "Think process analysis",
    "safety_failure": "Safety failure",
    "efficiency_failure": "Efficiency failure",
    "correction": "Actionable correction",
}
"""The fields of `Feedback` and their headings, in the order in which they are numbered."""
MOST_CHARACTERS: Final = 1500
"""Of a section; those of the paper have 400 at most."""
_HEADINGS: Final = re.compile(
    r"^[ \t]*(?:[-*][ \t]+)?\**[ \t]*([1-5])\.[ \t]*("
    + "|".join(map(re.escape, SECTIONS.values()))
    + r")[ \t]*\**[ \t]*:[ \t]*\**",
    re.MULTILINE | re.IGNORECASE,
)
_WRONG: Final = (
    "The driving score is {score}. The score is below the threshold, and the result is wrong. "
    "Please follow the prompts to regenerate the correct trajectory."
)
_RIGHT: Final = "The driving score is {score}. The score is not below the threshold, and the result is right."
_VERDICT: Final = re.compile(r"The driving score is (\d\.\d{1,4})\. The score is (not )?below the threshold")


class FeedbackError(ValueError):
    """A text that is no feedback; it says what is missing or too much."""


@dataclass(frozen=True)
class RuleFeedback:
    """The verdict by rule (figure 8a); of a plan that is right the paper shows no text, and this one is ours.

    Attributes:
        score: 0 to 1, told with four decimals at most.
        correct: whether the score is at least the threshold.
    """

    score: float
    correct: bool

    def __post_init__(self) -> None:
        if not 0.0 <= self.score <= 1.0:
            raise FeedbackError(f"a score lies between 0 and 1, not at {self.score}")
        object.__setattr__(self, "score", round(self.score, 4) + 0.0)

    def __str__(self) -> str:
        # A whole number keeps one decimal, as in the paper; no score is told with an exponent.
        told = f"{self.score:.4f}".rstrip("0")
        return (_RIGHT if self.correct else _WRONG).format(score=told + "0" * told.endswith("."))


@dataclass(frozen=True)
class Feedback:
    """A teacher's five sections (figures 7 and 8b), a paragraph each."""

    meta_action: str
    think_process: str
    safety_failure: str
    efficiency_failure: str
    correction: str

    def __post_init__(self) -> None:
        for field, heading in SECTIONS.items():
            _check(heading, getattr(self, field))

    def __str__(self) -> str:
        told = (
            f"**{number}. {heading}:** {getattr(self, field)}"
            for number, (field, heading) in enumerate(SECTIONS.items(), 1)
        )
        return "\n".join((BEGIN, *told, END))


def parse_feedback(text: str) -> Feedback | RuleFeedback:
    """What a text says, whoever wrote it: the inverse of ``str``.

    Of five sections, headings may be written in any case, with or without asterisks and tags, and paragraphs
    over several lines.

    Raises:
        FeedbackError: it is neither five sections nor a verdict.
    """
    if found := _VERDICT.match(text):
        verdict = RuleFeedback(float(found[1]), correct=found[2] is not None)
        if str(verdict) != text.strip():
            raise FeedbackError(f"a verdict reads {str(verdict)!r}")
        return verdict
    inside = _within_tags(text)
    headings = list(_HEADINGS.finditer(inside))
    expected = list(enumerate(SECTIONS.values(), 1))
    told = [(int(each[1]), each[2].capitalize()) for each in headings]
    if told != expected:
        wanted = next(
            (pair for pair, got in zip(expected, [*told, (0, "")], strict=False) if pair != got), None
        )
        if wanted is None:
            raise FeedbackError("there is a heading behind the five sections")
        raise FeedbackError(
            f"write the five sections in their order; '{wanted[0]}. {wanted[1]}:' is not there"
        )
    if inside[: headings[0].start()].strip():
        raise FeedbackError(f"begin with '1. {SECTIONS['meta_action']}:'")
    ends = [each.start() for each in headings[1:]] + [len(inside)]
    paragraphs = [
        " ".join(inside[each.end() : end].split()) for each, end in zip(headings, ends, strict=True)
    ]
    return Feedback(*paragraphs)


def _within_tags(text: str) -> str:
    """What stands between the tags; all of a text without tags."""
    begins, ends = text.count(BEGIN), text.count(END)
    if (begins, ends) == (0, 0):
        return text
    if (begins, ends) != (1, 1) or text.index(END) < text.index(BEGIN):
        raise FeedbackError(f"write one {BEGIN} and one {END} behind it")
    before, _, rest = text.partition(BEGIN)
    inside, _, behind = rest.partition(END)
    if before.strip() or behind.strip():
        raise FeedbackError(f"write nothing before {BEGIN} or behind {END}")
    return inside


def _check(heading: str, text: str) -> None:
    if not text:
        raise FeedbackError(f"section '{heading}' is empty")
    if len(text) > MOST_CHARACTERS:
        raise FeedbackError(f"section '{heading}' has {len(text)} characters; {MOST_CHARACTERS} are enough")
    if " ".join(text.split()) != text or not text.isprintable():
        raise FeedbackError(f"section '{heading}' is one paragraph, without line breaks or doubled spaces")
    if BEGIN in text or END in text or _HEADINGS.match(text):
        raise FeedbackError(f"section '{heading}' holds a tag or begins with a heading")
