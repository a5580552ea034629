"""What a vision-language teacher is told: task, rules, pictures, both plans (after CF-VLA section 8)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, get_args

from looktwice.clients.labelling.checks import MOST_WORDS, FailedCheck
from looktwice.clients.labelling.teachers.phrase_answers import TABLE
from looktwice.clients.labelling.teachers.teacher import Question
from looktwice.model.driving.outcome import in_words
from looktwice.model.driving.phrases import FARTHEST_M, ReflectionLanguage, Spot
from looktwice.model.driving.plan import WORDS
from looktwice.model.driving.scene import CLIP_FRAMES, CLIP_PERIOD_S, FRONT_TELE, FRONT_WIDE, Clip

PROMPT_VERSION: Final = 2
"""Raised with every change of wording: other words, other answers."""

_CAMERAS: Final = {
    FRONT_WIDE: "looks ahead with a field of view of 120 degrees",
    FRONT_TELE: "looks ahead with a field of view of 30 degrees",
}
_GROUPS: Final = "\n".join(f"- {group}: {', '.join(words)}" for group, words in WORDS.items())

_TASK: Final = f"""You are the driver of a car and look back at the plan that you have just made, \
before you act on it. You see the road through the car's cameras. You write what goes through your \
mind: what on the road asks for another plan, what would come of the plan as it is, and how to change it.

A plan covers the next 6.4 seconds in three groups of actions, each over a stretch of time:
{_GROUPS}

You are also given a better plan, as a hint that stays with you: use it to find out what to look \
for, and let your thoughts lead towards it. Never let on that you have it.

Rules:"""
_FREE_TEXT: Final = f"""{_TASK}
- One paragraph of plain English sentences, in the first person, {MOST_WORDS} words at most. No \
line breaks, no lists, no markup, no headings.
- Name what you see that asks for the change: vehicles, people, markings, the run of the road, \
obstacles, lights.
- Say what your plan would lead to, and which change is better: slower or faster, which way, which \
lane.
- Do not list the better plan, its times or its wording.
- Do not speak of experts, answers, labels, data, recordings, pictures or predictions, nor of \
anything that will only be known later. You know what is on the road now, and nothing else.
- Where the two plans hardly differ, say briefly what on the road supports yours."""
_PHRASES: Final = f"""{_TASK}
- Answer with JSON: {{"statements": [...]}}, at most one statement for each group that is to change, in \
the order of the groups above. Where the plans hardly differ, there is none.
- A statement has the fields seen, place, ahead_m, consequence and correction.
- seen: what is on the road now and asks for the change. place (one of: {", ".join(get_args(Spot))}) and \
ahead_m (metres, 0 to {FARTHEST_M}) belong to vehicles, people and obstacles, ahead_m also to a bend; \
otherwise they are null.
- consequence: what going on as planned would lead to. correction: what to do instead. They go together \
like this:
{TABLE}
- State only what the cameras show, and only changes that lead towards the better plan."""
SYSTEM: Final[Mapping[ReflectionLanguage, str]] = {"free_text": _FREE_TEXT, "phrases": _PHRASES}
"""What a teacher is told first, by what it is to write."""


@dataclass(frozen=True)
class Text:
    """A part of a message."""

    text: str


@dataclass(frozen=True)
class PicturePart:
    """A picture, encoded, between parts of text."""

    image: bytes


Part = Text | PicturePart


def camera_line(clip: Clip) -> str:
    """What is said before a clip's pictures."""
    looks = _CAMERAS.get(clip.camera, "is one of the car's cameras")
    span_s = CLIP_PERIOD_S * (CLIP_FRAMES - 1)
    return f"Camera {clip.camera} {looks}. What it shows over {span_s:g} seconds, the last one is now:"


def user_message(
    question: Question, complaints: Sequence[FailedCheck], reflection: ReflectionLanguage
) -> list[Part]:
    """The question itself, pictures in their order, and what was wrong with earlier answers."""
    parts: list[Part] = []
    for clip in question.scene.clips:
        parts.append(Text(camera_line(clip)))
        parts += [PicturePart(image) for image in clip.images]
    parts.append(
        Text(f"The better plan, for you alone:\n{question.expert}\nYour plan:\n{question.predicted}")
    )
    if question.outcome is not None:
        parts.append(
            Text(
                f"A hint, for you alone: driven as it is, your plan {in_words(question.outcome)}. "
                "Look for what shows that now, and name it only as far as you see it."
            )
        )
    if complaints:
        told = "\n".join(f"- {each.detail}" for each in dict.fromkeys(complaints))
        parts.append(Text(f"You wrote an answer before that cannot be used. This time:\n{told}"))
    parts.append(Text("Write the paragraph." if reflection == "free_text" else "Write the JSON."))
    return parts
