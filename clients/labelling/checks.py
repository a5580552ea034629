"""What a reflection must be before a model is trained on it, whoever wrote it."""

from __future__ import annotations

import re
from typing import Final, Literal, NamedTuple

from looktwice.clients.labelling.leaks import find_leaks
from looktwice.model.driving.direction import CORRECTION, agrees, group_of, track_changes, wanted_changes
from looktwice.model.driving.phrases import Facts, facts_of
from looktwice.model.driving.plan import Plan

MOST_WORDS: Final = 80
"""CF-VLA section 8: one short paragraph."""
MOST_CHARACTERS: Final = 2000
"""Far more than so many words have. The time of the checks grows with the square of a text's length."""

Check = Literal["answer", "form", "length", "leak", "anchor", "direction", "number"]

_MARKUP: Final = re.compile(
    r"[*`#|<>\[\]{}~\\]|^\s*(?:[-+\u2022]|\d+[.)])\s|__|https?://|"
    r"\b(?:Meta Actions|Thinking|Action|Reasoning|Reflection|Note):"
)
_SENTENCE_END: Final = re.compile(r"[.!?]$")
_SENTENCES: Final = re.compile(r"(?<=[.!?;])\s+")
_THINGS: Final = (
    r"vehicles?|cars?|vans?|trucks?|bus(?:es)?|motorcycl\w+|cyclists?|bicycles?|leaders?|traffic|queues?|"
    r"brake lights?|tail lights?|pedestrians?|persons?|people|walkers?|cones?|barriers?|obstacles?|"
    r"lane (?:lines?|markings?)|markings?|crosswalks?|kerbs?|lights?|signs?|signals?|construction|closure"
)
_ROADS: Final = (
    r"lanes?|curves?|bends?|bending|junctions?|intersections?|crossings?|shoulder|roads?|gaps?|horizon"
)
_THING: Final = re.compile(rf"\b(?:{_THINGS})\b", re.IGNORECASE)
_CUE: Final = re.compile(rf"\b(?:{_THINGS}|{_ROADS})\b", re.IGNORECASE)


class FailedCheck(NamedTuple):
    """Why a reflection is not taken; ``detail`` tells its writer what to change."""

    check: Check
    detail: str


def check_reflection(text: str, predicted: Plan, expert: Plan) -> list[FailedCheck]:
    """What is wrong with a reflection on ``predicted`` that leads to ``expert``; empty where nothing is.

    Args:
        text: of a teacher. One in phrases is checked by its facts: its form, its length and that every
            change has a cue are given, and it may leave out changes of whole tracks.
        predicted: the model's own plan, which the text looks at.
        expert: the plan that comes behind the text.
    """
    if len(text) > MOST_CHARACTERS:
        return [FailedCheck("length", f"write at most {MOST_WORDS} words")]
    if (facts := facts_of(text)) is not None:
        return _check_facts(facts, predicted, expert)
    failed: list[FailedCheck] = []
    if not text.strip():
        return [FailedCheck("form", "write one short paragraph")]
    if text != text.strip() or text.splitlines() != [text] or not text.isprintable():
        failed.append(FailedCheck("form", "write one paragraph without line breaks"))
    if found := _MARKUP.search(text):
        failed.append(FailedCheck("form", f"write plain sentences, without {found.group().strip()!r}"))
    if not _SENTENCE_END.search(text.strip()):
        failed.append(FailedCheck("form", "end with a full sentence"))
    if (words := len(text.split())) > MOST_WORDS:
        failed.append(FailedCheck("length", f"write at most {MOST_WORDS} words; these are {words}"))
    for leak in find_leaks(text):
        failed.append(FailedCheck("leak", f"do not say {leak.phrase!r}: it hints at {leak.kind}"))
    if not _is_anchored(text):
        failed.append(FailedCheck("anchor", "name what is to be seen on the road that asks for each change"))
    if not agrees(text, predicted, expert):
        failed.append(FailedCheck("direction", "the text asks for another change than the plan needs"))
    return failed


def _check_facts(facts: Facts, predicted: Plan, expert: Plan) -> list[FailedCheck]:
    if not facts.statements and wanted_changes(predicted, expert):
        return [FailedCheck("direction", "the plan needs a change, and none is stated")]
    return [
        FailedCheck("direction", f"the plan needs another change than {change!r} in track {group}")
        for change in facts.changes
        for group in [group_of(change)]
        if change not in track_changes(predicted, expert, group)
    ]


def _is_anchored(text: str) -> bool:
    """Whether at least as much is seen as is asked for, up to every correction.

    "I should stay in my lane" names the lane as what to do and not as what is seen: behind the word that asks
    for a change only things count.
    """
    seen = corrections = 0
    for sentence in _SENTENCES.split(text):
        asks = CORRECTION.search(sentence)
        if asks is None:
            seen += len(_CUE.findall(sentence))
            continue
        seen += len(_CUE.findall(sentence[: asks.start()])) + len(_THING.findall(sentence[asks.start() :]))
        corrections += 1
        if seen < corrections:
            return False
    return seen > 0
