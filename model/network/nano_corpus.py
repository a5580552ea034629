"""Plain driving English that the nano tokenizer is trained on: own sentences, expanded from templates.

The texts matter for compactness only: any other text is still written, in more tokens.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterator, Sequence
from typing import Final

from looktwice.model.driving.plan import TICKS, WORDS, format_tick
from looktwice.model.driving.scene import CAMERAS
from looktwice.model.families.registry import family_named
from looktwice.model.network.chat_prompt import SYSTEM, prompt_text
from looktwice.model.network.vla_settings import NANO_SETTINGS, VlaSettings

_SLOTS: Final[dict[str, tuple[str, ...]]] = {
    "agent": (
        "the lead vehicle",
        "the car ahead",
        "a slow truck",
        "a van in the right lane",
        "the bus in front",
        "a cyclist",
        "a motorcycle",
        "the white car in the next lane",
        "an oncoming vehicle",
        "a parked car",
    ),
    "person": (
        "a pedestrian",
        "a person near the curb",
        "someone at the crosswalk",
        "a child beside the road",
        "a group of pedestrians",
        "a worker",
    ),
    "side": ("left", "right"),
    "other": ("left", "right"),
    "speed": ("slowly", "at low speed", "at moderate speed", "quickly", "at high speed", "at walking pace"),
    "place": (
        "intersection",
        "roundabout",
        "curve",
        "crosswalk",
        "ramp",
        "merge",
        "junction",
        "exit",
        "stop line",
        "construction zone",
        "T-junction",
        "bend",
    ),
    "object": (
        "traffic cones",
        "a barrier",
        "a stopped vehicle",
        "a queue of cars",
        "debris",
        "a closed lane",
        "a broken-down car",
        "road works",
        "a warning sign",
    ),
    "light": ("green", "red", "yellow"),
    "weather": ("clear", "wet", "dark", "bright", "foggy", "dry"),
    "number": ("5", "8", "12", "15", "20", "25", "30", "40", "50", "60", "80"),
    "word": tuple(word.lower() for words in WORDS.values() for word in words),
    "tick": ("0.5", "1.2", "2.0", "3.1", "4.4", "5.7"),
}

_TEMPLATES: Final = """
The ego vehicle is moving {speed} on a straight road with two lanes.
The ego vehicle is approaching a {place} and the road ahead is {weather}.
The road is {weather} and there is no traffic ahead, so the ego vehicle can keep its speed.
There is {agent} about {number} meters ahead in the same lane.
{agent} is braking and its brake lights are on.
{agent} is moving {speed}, so the gap is closing.
{agent} is cutting in from the {side} and leaves little space.
{agent} is merging into our lane from the {side}.
{agent} has stopped in the lane, which blocks the way.
{agent} is turning {side} at the {place}.
{agent} is signalling to change to the {side} lane.
{agent} is far away and does not affect the plan.
{agent} starts to move again, so waiting longer is not needed.
{agent} pulls away and the distance is growing.
{person} is crossing the road from the {side}.
{person} is waiting at the {place} and may step onto the road.
{person} has already crossed, so the way is free again.
{person} is walking along the {side} edge of the road.
There are {object} in the {side} lane ahead.
The {side} lane is closed by {object}, so a lane change to the {other} is needed.
The {side} lane is free and its markings are dashed.
The lane markings on the {side} are solid, so a lane change is not allowed.
The traffic light at the {place} is {light}.
The light turns {light}, so the ego vehicle should react early.
The speed limit is about {number} kilometers per hour.
The ego vehicle is driving at {number} km/h, which is too fast for the {place}.
The ego vehicle is driving at {number} km/h, which is slower than the surrounding traffic.
The ego vehicle is standing still behind {agent}.
The road curves to the {side} after about {number} meters.
The road bends sharply to the {side}, so the speed must come down before the {place}.
The route leads to the {side} at the next {place}.
The route continues straight ahead through the {place}.
The route asks for the {side} lane, but the ego vehicle is still in the {other} lane.
The telephoto camera shows {object} far ahead.
The wide camera shows {agent} close to the {side} side.
In both cameras the distance to {agent} is shrinking from frame to frame.
The view is blocked by {agent}, so caution is advised.
The predicted plan keeps the speed although {agent} is slowing down.
The predicted plan accelerates too early, before the {place} is clear.
The predicted plan starts to {word} at {tick}s, which is too late.
The predicted plan starts to {word} at {tick}s, which is too early.
The proposed meta-actions ignore {person} who is about to cross.
The proposed meta-actions stay in the lane although {object} block it.
The proposed meta-actions turn {side} although the road continues straight.
The proposed lane change to the {side} is not needed because the lane ahead is free.
The proposed lane change to the {side} is risky because {agent} is next to us.
Keeping the speed would bring the ego vehicle too close to {agent}.
Accelerating now would lead to a collision with {agent}.
Braking this hard is not necessary because {agent} is far away.
Waiting is not required because the way is free.
Instead, the ego vehicle should {word} until {tick}s and then {word}.
Instead, it should decelerate first, then keep a safe distance behind {agent}.
It would be better to slow down early and smoothly before the {place}.
It is safer to wait until {person} has left the road.
It is safer to keep the lane and let {agent} pass.
A better plan is to slow down now and accelerate again after the {place}.
A better plan is to change to the {side} lane before reaching {object}.
A gentle {side} turn is needed to follow the lane.
The turn to the {side} should begin later, at about {tick}s.
The turn to the {side} should end earlier, at about {tick}s, and the rest is straight.
Therefore the longitudinal plan should change from {word} to {word}.
Therefore the lateral plan should be {word} for the whole horizon.
Therefore the lane plan should be {word} after {tick}s.
The lateral and lane actions are fine and stay as they are.
The longitudinal actions are fine, but the lateral actions need a correction.
The predicted meta-actions are already good because they keep a safe distance.
The predicted meta-actions match the scene, so no correction is needed.
The expected consequence is a hard brake or even a crash at about {tick}s.
The expected consequence is leaving the lane on the {side} side.
The stopping distance at this speed is longer than the gap to {agent}.
The time gap to {agent} is less than two seconds.
The ego vehicle must yield to {agent} at the {place}.
The ego vehicle has the right of way, but {agent} might not yield.
The ego vehicle is on a ramp and has to merge into faster traffic.
The ego vehicle is inside a roundabout and will leave it at the next exit.
The ego vehicle is on a highway with several lanes and light traffic.
The ego vehicle is in dense traffic that stops and goes.
The traffic ahead is moving {speed} and the queue is about {number} meters long.
The queue ahead is starting to move, so a careful acceleration is possible.
The shoulder on the {side} is narrow and there is no space to avoid {object}.
There is enough room on the {side} to pass {object} safely.
""".strip().splitlines()

_WORDS_ALONE: Final = """
vehicle vehicles car cars truck trucks bus van motorcycle bicycle cyclist pedestrian pedestrians road lane
lanes street highway distance meters seconds speed brake brakes braking accelerate accelerating decelerate
decelerating slow slower fast faster stop stopped stopping wait waiting turn turning left right straight
ahead behind beside close closer far near safe safely unsafe danger dangerous risk risky collision hazard
cautious caution careful carefully because therefore however instead although while before after until since
so but and or not no the a an is are was were will would should could must may might can cannot need needs
needed keep keeps keeping change changes changing merge merging yield yielding cross crossing follow
following overtake overtaking pass passing approach approaching enter entering leave leaving exit reverse
reversing park parked signal signals light lights green red yellow sign signs marking markings line lines
curb sidewalk crosswalk intersection roundabout junction curve bend corner ramp bridge tunnel barrier cone
cones construction worker work zone closed open free clear blocked occupied visible hidden scene camera
front wide tele image frame history route trajectory plan planned planning action actions meta longitudinal
lateral segment interval time start starts begin begins end ends early earlier late later now then next
first second third motion gap headway time-to-collision stopping comfortable smooth smoothly sharp sharply
gentle gently hard slightly more less too very enough also only already still again likely unlikely expected
consequence consequences reason correct correction incorrect wrong better best good fine necessary required
allowed traffic oncoming leading lead adjacent neighboring parallel opposite same other another both each
all some several few two three four five six north south east west weather rain night day bright dark shadow
sun reflection view tree trees building buildings wall fence grass hill flat uphill downhill surface asphalt
gravel wet dry ice driver ego self system user assistant it its this that these those there here they them
their he she we our you your in on at to from into onto of for with without by as than over under between
across along around through within about per hour kilometers ahead, vehicle. lane. road.
"""


def driving_sentences(per_template: int = 12, seed: int = 0) -> Iterator[str]:
    """Sentences about scenes, hazards and corrections; the same for the same arguments.

    Every template is filled ``per_template`` times, each time with other words.
    """
    random_ = random.Random(seed)
    for template, _ in itertools.product(_TEMPLATES, range(per_template)):
        sentence = template
        while (start := sentence.find("{")) >= 0:
            end = sentence.index("}", start)
            sentence = (
                sentence[:start] + random_.choice(_SLOTS[sentence[start + 1 : end]]) + sentence[end + 1 :]
            )
        yield sentence[0].upper() + sentence[1:]
    yield " ".join(_WORDS_ALONE.split())


def nano_phrases(formats: Sequence[str] = NANO_SETTINGS.formats) -> tuple[str, ...]:
    """Runs of text that the nano tokenizer has a token for: what prompts and responses are made of.

    A small model spends its passes on choices, then, not on spelling.
    """
    families = [family_named(name) for name in formats]
    own = itertools.chain.from_iterable(family.corpus.phrases for family in families if family.corpus)
    return (SYSTEM, *(family.task for family in families), *own)


def nano_corpus(formats: Sequence[str] = NANO_SETTINGS.formats) -> Iterator[str]:
    """Everything the nano tokenizer of a checkpoint that writes ``formats`` is trained on."""
    for phrase in nano_phrases(formats):
        yield from [phrase] * 50
    for tick in range(TICKS + 1):
        yield from [f"{format_tick(tick)}  - {format_tick(tick)}s-"] * 50
    yield from driving_sentences()
    for format in formats:
        if corpus := family_named(format).corpus:
            yield from corpus.responses(list(driving_sentences(per_template=3)))
    for format in formats:
        for route in (False, True):
            # Often enough that the prompt's own words become single tokens.
            for tokens in (0, NANO_SETTINGS.scene_tokens):
                settings = VlaSettings(cameras=CAMERAS, scene_tokens=tokens)
                yield from ["".join(prompt_text(format, settings, route=route, tracks=route))] * 20
