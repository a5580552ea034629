"""Which way a reflection wants a plan to change, as far as words tell.

A clause speaks of an action ("accelerate", "ease off", "move left"); it speaks against it where it tells a
bad consequence of it ("accelerating would …", "too early", "instead of …"). What is spoken against counts for
the opposite.
"""

from __future__ import annotations

import re
from itertools import accumulate
from typing import Final, Literal, get_args

from looktwice.model.driving.plan import GROUPS, TICKS, Group, Plan, Track, plan_from_bins

Change = Literal["slower", "faster", "left", "right", "straight", "lane_left", "lane_right", "keep_lane"]
CHANGES: Final[tuple[Change, ...]] = get_args(Change)
"""Track by track, in the order of a plan's tracks."""

_LEVEL: Final = {"Accelerate": 1, "Keep Speed": 0, "Decelerate": -1, "Wait": -1, "Reverse": -1}
_CHANGE_OF: Final[dict[Group, dict[str, Change]]] = {
    "lateral": {"Left Turn": "left", "Right Turn": "right", "Straight": "straight"},
    "lane": {"Left Lane Change": "lane_left", "Right Lane Change": "lane_right", "Keep Lane": "keep_lane"},
}
_GAINS: Final[dict[Change, dict[str, int]]] = {
    "slower": {word: -level for word, level in _LEVEL.items()},
    "faster": _LEVEL,
    **{
        change: {word: int(each == change) for word, each in words.items()}
        for words in _CHANGE_OF.values()
        for change in words.values()
    },
}
KEEP_LANE: Final = "Keep Lane"
OTHER_LANE: Final[dict[Change, str]] = {
    "lane_left": "Right Lane Change",
    "lane_right": "Left Lane Change",
}
"""What nobody does first who is to move to the lane on one side."""
_PACE: Final[dict[Change, tuple[str, ...]]] = {"slower": ("Decelerate", "Wait"), "faster": ("Accelerate",)}
MIN_TICKS: Final = 5
"""Half a second, the shortest that the labeller calls an action of its own."""

_SLOWER: Final = (
    r"slow(?:s|ing|er(?! than))?(?: down| sooner| early)?|eas(?:e|es|ing) off|brak(?:e|es|ing)(?! lights?)|"
    r"decelerat\w+|hold(?:ing)? back|wait(?:s|ing)?|stop(?:s|ping)?|yield(?:s|ing)?|back(?:ing)? off|"
    r"come to a (?:stop|halt|standstill)|(?:reduce|lower|shed|lose)\w* (?:my |the )?speed|less speed|"
    r"stay(?:ing)? behind|give way|keep(?:ing)? (?:more |a larger |a safe )?(?:distance|gap)|"
    r"remain(?:ing)? stopped|stay(?:ing)? (?:put|stopped)|lift(?:ing)? off"
)
_FASTER: Final = (
    r"accelerat\w+|speed(?:s|ing)? up|pick(?:s|ing)? up speed|pull(?:s|ing)? away|get(?:ting)? going|"
    r"mov(?:e|es|ing) off|set(?:ting)? off|gain(?:s|ing)? speed|increas\w+ (?:my |the )?speed|more speed|"
    r"mak(?:e|es|ing) progress|driv(?:e|es|ing) on|go(?:ing)? faster|rais\w+ (?:my |the )?speed"
)
_LEFT: Final = r"(?:turn|bend|steer|curv)\w*(?: \w+){0,2} left|left(?: hand)? (?:turn|bend|curve)\w*"
_RIGHT: Final = (
    r"(?:turn|bend|steer|curv)\w*(?: \w+){0,2} right(?! ahead)|right(?: hand)? (?:turn|bend|curve)\w*"
)
_STRAIGHT: Final = r"straight(?:en\w*)?"
_MOVE: Final = r"(?:mov|chang|merg|pull|shift|switch)(?:e|es|ing|ge|ging)?(?: \w+){0,3}"
_LANE_LEFT: Final = rf"{_MOVE} left(?: lane)?|left lane change\w*"
_LANE_RIGHT: Final = rf"{_MOVE} right(?: lane)?|right lane change\w*"
_KEEP_LANE: Final = r"(?:stay|keep|remain)\w*(?: \w+){0,2} (?:in )?(?:my |this |the |our |its )?(?:\w+ )?lane"

_WORDS: Final[dict[Change, re.Pattern[str]]] = {
    "slower": re.compile(rf"\b(?:{_SLOWER})\b"),
    "faster": re.compile(rf"\b(?:{_FASTER})\b"),
    "left": re.compile(rf"\b(?:{_LEFT})\b"),
    "right": re.compile(rf"\b(?:{_RIGHT})\b"),
    "straight": re.compile(rf"\b(?:{_STRAIGHT})\b"),
    "lane_left": re.compile(rf"\b(?:{_LANE_LEFT})\b"),
    "lane_right": re.compile(rf"\b(?:{_LANE_RIGHT})\b"),
    "keep_lane": re.compile(rf"\b(?:{_KEEP_LANE})\b"),
}
_OPPOSITES: Final[dict[Change, tuple[Change, ...]]] = {
    "slower": ("faster",),
    "faster": ("slower",),
    "left": ("straight", "right"),
    "right": ("straight", "left"),
    "straight": ("left", "right"),
    "lane_left": ("keep_lane", "lane_right"),
    "lane_right": ("keep_lane", "lane_left"),
    "keep_lane": ("lane_left", "lane_right"),
}
_HENCE: Final = re.compile(r"^(?:(?:so|therefore|thus|instead|then)\b,?\s*)+")
_BECAUSE: Final = re.compile(
    r"\b(?:because|since|as|before|after|for|when|where|while|until|unless|if|than|instead of|that|which|who|"
    r"to(?! (?:the|my|a)\b))\b"
)
"""What comes behind it is a reason and no request; "to" as in "to pass the slow truck"."""
_REQUESTS: Final[dict[Change, str]] = {
    "slower": (
        r"slow(?= (?:down|sooner|earlier|early)|$)|ease off|brake(?! lights?)|decelerate|"
        r"(?:stop|yield)(?! signs?| lines?)|wait|back off|give way|hold back|lift off"
    ),
    "faster": r"accelerate|speed up|pick up speed|pull away|get going|move off|set off|gain speed|go faster",
    "left": r"(?:turn|steer|bear)(?: \w+){0,2} left",
    "right": r"(?:turn|steer|bear)(?: \w+){0,2} right",
    "lane_left": r"(?:move|change|merge|pull|shift|switch)(?: \w+){0,3} left",
    "lane_right": r"(?:move|change|merge|pull|shift|switch)(?: \w+){0,3} right",
}
_ASKED: Final = {
    change: re.compile(rf"(?:(?:\w+ly|also|then|just|rather|first|now|i should)\s+)*(?:{verbs})\b")
    for change, verbs in _REQUESTS.items()
}
"""Requests by the verb that they begin with."""
_ALIKE: Final[dict[Change, Change]] = {
    "left": "lane_left",
    "right": "lane_right",
    "lane_left": "left",
    "lane_right": "right",
}
"""One steers left to get into the left lane."""
_SENTENCES: Final = re.compile(r"[.;:!?](?=\s|$)\s*")
_CLAUSES: Final = re.compile(
    r"[.;:!?,](?=\s|$)|\b(?:so(?! (?:long|much|far|early|late|fast|hard|soon))|but|therefore|thus|"
    r"instead(?! of)|which is why|rather than|instead of|while)\b"
)
CORRECTION: Final = re.compile(
    r"\b(?:should|must|ought to|have to|need to|had better|better to)\b", re.IGNORECASE
)
"""What asks for a change."""
_AGAINST: Final = re.compile(
    r"\b(?:if|would|could|might|risks?|too|not|no|never|without|avoid\w*|premature\w*|needless\w*|unnecessar\w+|"
    r"wrong\w*|leaves? (?:no|little)|instead of|rather than|my plan|i plan\w*|the plan|planned|keeps? me)\b"
)


def wanted_changes(before: Plan, after: Plan) -> list[frozenset[Change]]:
    """What ``after`` does otherwise than ``before``, track by track: the changes that a text may name.

    Tracks that differ for less than half a second are left out, and those whose change has no direction.
    """
    return [changes for group in GROUPS if (changes := track_changes(before, after, group))]


def track_changes(before: Plan, after: Plan, group: Group) -> frozenset[Change]:
    """The directions, each for half a second or longer, in which one track changes."""
    return frozenset(
        change for change in CHANGES if group_of(change) == group and changed(before, after, change)
    )


def group_of(change: Change) -> Group:
    """The track that a change is of."""
    return next((group for group, words in _CHANGE_OF.items() if change in words.values()), "longitudinal")


def gain(change: Change, word: str) -> int:
    """How much a tick with a word of the change's track counts for it: -1, 0 or 1."""
    return _GAINS[change][word]


def done(plan: Plan, change: Change) -> int:
    """How much a plan does of what a change asks for more of, in ticks."""
    return counted(plan.track(group_of(change)), change)[-1]


def changed(before: Plan, after: Plan, change: Change) -> bool:
    """Whether a plan does more of a change than another, for half a second or longer, and nothing against it.

    Who slows down is not half a second ahead of the other plan in speeding up first, who picks up speed not
    behind. Who stays in the lane leaves it nowhere, and who moves to one side moves to the other only later.
    Who steers straight where the other plan turns does not put that turn off for too long (`puts_off`).
    """
    todo = needed(before, change)
    if done(after, change) < todo:
        return False
    group = group_of(change)
    if change == "straight":
        gained = counted(after.lateral, change)
        return not any(
            puts_off(change, before.lateral, each.word, each.start, each.end, todo - gained[each.start])
            for each in plan_from_bins(after.bins()).lateral or ()
        )
    if group == "longitudinal":
        both = zip(counted(before.track(group), change), counted(after.track(group), change), strict=True)
        return all(other > one - MIN_TICKS for one, other in both)
    move = _first_move(after)
    if change == "keep_lane":
        return move is None
    return change not in OTHER_LANE or move != OTHER_LANE[change]


def puts_off(change: Change, before: Track | None, word: str, start: int, end: int, todo: int) -> bool:
    """Whether a meta-action of a revised plan puts a turn of the first plan off for too long.

    Who is to steer straight for longer where the first plan turns can turn for less long, begin to turn
    later, or not turn at all. A turn that begins when it is too late to cut the first one short is none of
    these.

    Args:
        change: that is asked for.
        before: the first plan's track.
        word, start, end: the meta-action, from tick to tick.
        todo: how much of the change is left to do at ``start``, in ticks.
    """
    if change != "straight" or gain(change, word) < 1 or end == TICKS:
        return False
    turns = any(action.start <= start < action.end and action.word != word for action in before or ())
    return turns and TICKS - end < todo


def _first_move(plan: Plan) -> str | None:
    """The first lane change of a plan, if it has one."""
    return next((action.word for action in plan.lane or () if action.word != KEEP_LANE), None)


def counted(track: Track | None, change: Change) -> tuple[int, ...]:
    """How much a track does for a change until each of the ticks 0 to `TICKS`, as `done` counts."""
    each = [gain(change, action.word) for action in track or () for _ in range(action.start, action.end)]
    return tuple(accumulate(each or [0] * TICKS, initial=0))


def needed(before: Plan, change: Change) -> int:
    """How much a plan has to do, as `done` counts, to be changed in a direction; beyond `TICKS` none can.

    A plan that moves to the lane on one side already is not changed by moving there.
    """
    if change in OTHER_LANE and _first_move(before) not in (None, OTHER_LANE[change]):
        return TICKS + 1
    return done(before, change) + MIN_TICKS


def stated_changes(text: str) -> dict[Change, int]:
    """How often a text speaks for each change, less how often it speaks against it."""
    told = dict.fromkeys(_WORDS, 0)
    plain = " ".join(text.casefold().replace("-", " ").split())
    start = 0
    for end in [*_CLAUSES.finditer(plain), None]:
        clause = plain[start : end.start() if end else len(plain)]
        against = bool(_AGAINST.search(clause)) or plain[:start].endswith(("rather than", "instead of"))
        for change, pattern in _WORDS.items():
            count = len(pattern.findall(clause))
            told[change] += -count if against else count
        start = end.end() if end else len(plain)
    return told


def requested_changes(text: str) -> set[Change]:
    """What a text asks for in so many words: "I should …", "so …", and sentences that begin with the verb."""
    found: set[Change] = set()
    plain = " ".join(text.casefold().replace("-", " ").split())
    for sentence in _SENTENCES.split(plain):
        for clause in re.split(
            r",\s+(?=so\b|therefore\b|thus\b|instead\b|but\b)|\bso (?=\w)", f"{sentence} "
        ):
            request = _HENCE.sub("", clause)
            if marker := CORRECTION.search(request):
                request = request[marker.end() :].strip()
            request = _BECAUSE.split(request, maxsplit=1)[0]
            parts = re.split(r",|\b(?:and|or|then)\b", request)
            found |= {
                change for part in parts for change, asked in _ASKED.items() if asked.match(part.strip())
            }
    return found


def agrees(text: str, before: Plan, after: Plan) -> bool:
    """Whether a text speaks for one of the changes from ``before`` to ``after``, and asks for no other.

    Nor may it speak against one. Speaking against the opposite of a change is speaking for it. What a text
    only sees ("the road bends left") it does not ask for.
    """
    told, wanted = stated_changes(text), wanted_changes(before, after)
    about = {each for changes in wanted for change in changes for each in (change, *_OPPOSITES[change])}
    about |= {_ALIKE[change] for change in about if change in _ALIKE} | _done_in(after)
    if requested_changes(text) - about:
        return False
    spoken = False
    for changes in wanted:
        score = sum(told[change] for change in changes)
        others = {other for change in changes for other in _OPPOSITES[change]} - changes
        score -= sum(told[other] for other in others)
        if score < 0:
            return False
        spoken |= score > 0
    return spoken or not wanted


def _done_in(plan: Plan) -> set[Change]:
    """What a plan does for half a second or longer."""
    ticks = {change: _ticks(plan, "longitudinal", *words) for change, words in _PACE.items()}
    for group, changes in _CHANGE_OF.items():
        ticks |= {change: _ticks(plan, group, word) for word, change in changes.items()}
    return {change for change, count in ticks.items() if count >= MIN_TICKS}


def _ticks(plan: Plan, group: Group, *words: str) -> int:
    """For how many ticks a track of a plan says one of some words."""
    return sum(plan.word_at(group, tick) in words for tick in range(TICKS))
