"""What a reflection must never say: whatever its writer knows and a driver at the wheel does not.

The reflection stands between a model's own plan and a better one, as if the model had found out by itself. A
text that hints at where the better plan came from teaches the model to make sources up.
"""

from __future__ import annotations

import re
import unicodedata
from typing import Final, NamedTuple

_KINDS: Final[dict[str, tuple[str, ...]]] = {
    "an authority": (
        r"expert\w*",
        r"ground ?truth\w*",
        r"gts?",
        r"oracle\w*",
        r"teacher\w*",
        r"demonstrat(?:or|ion)s?",
        r"human (?:driver|demonstrat\w+|reference)\w*",
        r"(?:the )?(?:reference|target|gold|golden|desired|optimal|ideal|true|actual|real|recorded|logged) "
        r"(?:plan|driver|action|actions|trajectory|path|behaviou?r|answer|solution|response|meta actions?)",
        r"(?:correct|right|expected) (?:answer|label|meta actions?)|(?:correct|expected) plan",
        r"(?:better|alternative|given|provided|suggested|proposed|second|other) (?:plan|trajectory|actions)",
        r"hint(?:s|ed)?",
        r"what (?:actually|really) happen\w*",
        r"(?:was|were|am|been) (?:told|given|informed|provided|instructed)",
    ),
    "a data set": (
        r"label(?:s|ed|led|ing|ling|l?er|l?ers)?",
        r"annotat\w+",
        r"data ?sets?",
        r"training (?:data|set|samples?|examples?)",
        r"(?:driving|sensor|trajectory|log|ride) (?:log|logs|recordings?|data)",
        r"recordings?",
        r"footage",
        r"supervis\w+",
        r"benchmark\w*",
        r"simulat\w+",
    ),
    "evidence that is no view of the road": (
        r"(?:according to|based on|judging (?:by|from)|given|as (?:seen|shown) (?:in|by)) the "
        r"(?:\w+ )?(?:images?|pictures?|frames?|videos?|clips?|trajector(?:y|ies)|history|data|route data)",
        r"(?:images?|pictures?|frames?|videos?|clips?|trajector(?:y|ies)|data|histor(?:y|ies)|meta actions?) "
        r"(?:\w+ )?(?:shows?|suggests?|indicates?|reveals?|implies|imply|confirms?|tells?|hints?)",
        r"in the (?:\w+ )?(?:images?|pictures?|frames?|videos?|clips?)",
        r"annotated|bounding box(?:es)?|coordinates?|way ?points?|detections?",
    ),
    "the future": (
        # Of oneself one may say what one will do.
        r"(?!(?:i|we) )\w+ (?:will|shall|is going to|are going to)",
        r"(?!(?:i|we)')\w+'ll",
        r"(?:turns|turned) out",
        r"(?:ends?|ended) up",
        r"(?:later|soon|then|eventually|subsequently|afterwards) "
        r"(?:brakes?|stops?|turns?|merges?|cross(?:es)?|leaves?|slows?|accelerates?|clears?)",
        r"(?:\d+(?:\.\d+)?|one|two|three|four|five|six|a few|some) seconds? later",
        r"in the future|future (?:motion|poses?|trajectory|frames?|positions?|behaviou?r)",
        r"(?:seems?|appears?|looks?) (?:to be )?(?:about|likely|set|ready|going) to",
        r"about to",
        r"in hindsight|with hindsight|retrospect\w*",
    ),
    "the writer": (
        r"as an? (?:ai|assistant|language model|labell?ing assistant)",
        r"language models?|chatbots?",
        r"predict(?:ed|ion|ions|or)",
        r"(?:the|these|my|your) (?:instructions?|prompts?|task|rules)",
        r"meta commentary|reasoning trace|self reflection|counterfactual\w*",
        r"i (?:cannot|can't|can not|am unable to) (?:answer|help|see|provide)",
    ),
}
_PATTERNS: Final = {kind: re.compile(r"\b(?:" + "|".join(parts) + r")\b") for kind, parts in _KINDS.items()}
_HIDDEN: Final = re.compile("[\u00ad\u200b-\u200f\u2060\ufeff]")
_JOINTS: Final = re.compile(r"[\s_\-\u2010-\u2015/]+")


class Leak(NamedTuple):
    """A phrase that gives away knowledge, and of what."""

    phrase: str
    kind: str


def find_leaks(text: str) -> list[Leak]:
    """The phrases of ``text`` that give away what no driver could know, however spaced and hyphenated."""
    plain = _HIDDEN.sub("", unicodedata.normalize("NFKC", text)).casefold().replace("\u2019", "'")
    plain = _JOINTS.sub(" ", plain)
    return [
        Leak(found.group(), kind) for kind, pattern in _PATTERNS.items() for found in pattern.finditer(plain)
    ]
