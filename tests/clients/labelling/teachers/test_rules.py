from __future__ import annotations

import asyncio
import itertools
import re
from contextlib import suppress

import numpy as np
import pytest

from looktwice.clients.labelling.checks import check_reflection
from looktwice.clients.labelling.teachers.rules import RuleTeacher
from looktwice.clients.labelling.teachers.teacher import Question, TeacherError
from looktwice.model.bundled import SCENES
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.phrases import NOTHING, agrees, corrected, read_facts
from looktwice.model.driving.plan import WORDS, Plan, track_from_words
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.view import Surroundings

BUNDLED = list(read_scenes(SCENES, dense=False))
STRAIGHT = next(labelled for labelled in BUNDLED if "turn" not in labelled.tags)
PLANS = [expert_plan(each) for each in BUNDLED]
INDEPENDENT = re.compile(
    r"expert|truth|label|annot|dataset|data set|predict|image|frame|video|camera|picture|trajector|will\b|"
    r"going to|about to|later\b.*(?:stop|turn|brake)|oracle|teacher|simulat|future|ground|hindsight",
    re.IGNORECASE,
)
TEACHER = RuleTeacher()


def reflect(labelled: LabelledScene, predicted: Plan, better: Plan, seed: int = 0) -> str:
    question = Question(labelled.scene, predicted, better, Surroundings.of(labelled), seed)
    return asyncio.run(TEACHER.reflect(question)).text


def made_up(random: np.random.Generator) -> Plan:
    """A plan of two words a track."""
    return Plan(
        **{
            group: track_from_words([words[first]] * edge + [words[second]] * (64 - edge))
            for group, words in WORDS.items()
            for first, second, edge in [(*random.integers(0, len(words), 2), int(random.integers(5, 60)))]
        }
    )


def test_what_it_writes_passes_all_checks() -> None:
    random = np.random.default_rng(0)
    pairs = [
        *itertools.product(BUNDLED, PLANS, PLANS),
        *((s, made_up(random), made_up(random)) for s in BUNDLED * 20),
    ]
    written = 0
    for seed, (labelled, predicted, better) in enumerate(pairs):
        try:
            text = reflect(labelled, predicted, better, seed)
        except TeacherError:  # nothing in view asks for it
            continue
        written += 1
        assert check_reflection(text, predicted, better) == [], text
        assert not INDEPENDENT.search(text), text
        assert len(text.split()) <= 80
    assert written > len(pairs) / 2


def test_it_is_silent_where_nothing_is_to_be_seen() -> None:
    """An empty road that runs straight asks for no turn, no other lane and no brakes."""
    straight = np.stack([np.arange(-20, 100, 2), np.zeros(60)], 1).astype(np.float32)
    road, keep = Surroundings((), (straight,)), made_of("Keep Speed", "Straight", "Keep Lane")
    for better in (
        made_of("Decelerate", "Straight", "Keep Lane"),
        made_of("Keep Speed", "Left Turn", "Keep Lane"),
        made_of("Keep Speed", "Straight", "Left Lane Change"),
    ):
        with pytest.raises(TeacherError, match="nothing in view"):
            asyncio.run(TEACHER.reflect(Question(STRAIGHT.scene, keep, better, road)))
    faster = made_of("Accelerate", "Straight", "Keep Lane")
    told = asyncio.run(TEACHER.reflect(Question(STRAIGHT.scene, keep, faster, road))).text
    assert "My lane is clear" in told


def made_of(longitudinal: str, lateral: str, lane: str) -> Plan:
    """A plan of one word a track."""
    return Plan(*(track_from_words([word] * 64) for word in (longitudinal, lateral, lane)))


def test_it_states_one_change_of_each_track_that_something_asks_for() -> None:
    random = np.random.default_rng(1)
    stated = 0
    for labelled in BUNDLED * 10:
        predicted, better = made_up(random), made_up(random)
        with suppress(TeacherError):
            facts = read_facts(reflect(labelled, predicted, better))
            revised = corrected(predicted, better, facts)
            assert agrees(facts, predicted, revised)
            stated += len(facts.statements)
    assert stated > 100


def test_it_says_that_a_good_plan_is_good() -> None:
    assert reflect(BUNDLED[0], PLANS[0], PLANS[0]) == NOTHING


def test_it_tells_distances_as_they_are_seen() -> None:
    told: list[int] = []
    for labelled, predicted, better in zip(BUNDLED, PLANS[1:] + PLANS[:1], PLANS, strict=True):
        with suppress(TeacherError):  # nothing in view asks for it
            told += [
                int(metres) for metres in re.findall(r"(\d+) metres", reflect(labelled, predicted, better))
            ]
    assert told
    assert all(5 <= metres <= 90 and metres % 5 == 0 for metres in told)


def test_it_says_what_it_lacks() -> None:
    with pytest.raises(TeacherError, match="annotations"):
        asyncio.run(TEACHER.reflect(Question(BUNDLED[0].scene, PLANS[0], PLANS[1])))
