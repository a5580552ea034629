"""What a tokenizer learns of CF-VLA: phrases of its plans and reflections, and whole responses."""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterator, Sequence
from typing import Final

from looktwice.model.driving.plan import GROUPS, TICKS, WORDS, Plan, track_from_words
from looktwice.model.families.cf_vla.format import ACTION, PLAN_START, THINKING
from looktwice.model.families.family import Corpus

_KINDS: Final = ("vehicle", "pedestrian", "traffic cone", "barrier")
_STATES: Final = ("", "standing ", "slower ", "braking ")
_PHRASES: Final = (
    PLAN_START,
    *(f"- {group}\n" for group in GROUPS),
    *(f" {word}" for words in WORDS.values() for word in words),
    *(f"A {state}{kind}" for kind in _KINDS for state in _STATES),
    *(f" some {metres} metres ahead" for metres in range(5, 105, 5)),
    *"""
 is in my lane
 is in the left lane
 is in the right lane
 is on the left side
 is on the right side
 is oncoming
 in my lane
 in the left lane
 in the right lane
 right ahead
The road bends left
The road bends right
The junction lets me go left
The junction lets me go right
My lane is clear
My lane ends
There is room in the left lane
There is room in the right lane
 Going on like this
 would bring me too close
 would leave no time to react
 would carry too much speed into the curve
 would get me stuck
 would carry me out of the lane
 would be needlessly cautious
 would be unnecessary
 would miss the way
, so I should brake and stop
, so I should slow down sooner
, so I should pick up speed
, so I should turn left
, so I should turn right
, so I should steer straight for longer
, so I should stay in my lane
, so I should move to the left lane
, so I should move to the right lane
s:
""".strip("\n").splitlines(),
    ACTION,
    THINKING,
)
"""What plans are made of, and reflections: what is seen and where, what would come of it, what is better."""


def random_plans(count: int, seed: int = 0) -> Iterator[Plan]:
    """Valid plans with one to four segments a group; the same for the same arguments."""
    random_ = random.Random(seed)
    for _ in range(count):
        tracks = {}
        for group in GROUPS:
            edges = sorted(random_.sample(range(1, TICKS), random_.randrange(4)))
            words = itertools.chain.from_iterable(
                [random_.choice(WORDS[group])] * (end - start)
                for start, end in zip([0, *edges], [*edges, TICKS], strict=True)
            )
            tracks[group] = track_from_words(list(words))
        yield Plan(**tracks)


def responses(sentences: Sequence[str]) -> Iterator[str]:
    """Whole responses without their trajectory codes (the labels of CF-VLA section 8)."""
    random_ = random.Random(0)
    plans = random_plans(600)
    for first, second in zip(plans, plans, strict=True):
        yield f"{PLAN_START}{first}{ACTION}\n"
        thinking = " ".join(random_.sample(sentences, 3))
        yield f"{PLAN_START}{first}{THINKING}\n{thinking}\n{PLAN_START}{second}{ACTION}\n"


CORPUS: Final = Corpus(_PHRASES, responses)
