from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from looktwice.model.driving.phrases import Statement, Thing
from looktwice.model.driving.plan import Plan, parse_plan
from looktwice.model.driving.trajectory import HISTORY_STEPS, constant_velocity
from looktwice.model.families.cf_vla import CF_VLA
from looktwice.model.families.cf_vla.format import PHRASES
from looktwice.model.families.cf_vla.targets import PAPER_WEIGHTS
from looktwice.model.families.cf_vla.traj_only import TRAJ_ONLY
from looktwice.model.families.family import Counterfactual, Lesson
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.formats.pieces import FormatError, Values
from looktwice.model.formats.text import parse
from looktwice.model.training.response_targets import make_target
from tests.model.formats.vocabulary import ByteVocabulary

VOCABULARY = ByteVocabulary()
CODES = (1, 2, 3, 4, 5, 6)
PLAN = parse_plan("- longitudinal\n  - 0.0s-6.4s: Wait\n")
WRONG = parse_plan("- longitudinal\n  - 0.0s-6.4s: Accelerate\n")


def lesson(plan: Plan, reflection: Counterfactual | None = None) -> Lesson:
    return Lesson(plan, CODES, constant_velocity(np.zeros((HISTORY_STEPS, 4), np.float32)), reflection)


def test_a_direct_target_says_plan_and_codes_with_the_papers_weights() -> None:
    compiled = CompiledFormat(CF_VLA.format, VOCABULARY)
    target = make_target(CF_VLA, compiled, lesson(PLAN), PAPER_WEIGHTS)
    values = parse(compiled, VOCABULARY.decode(target.ids), {"plan": PLAN})
    assert values == Values.of({"plan": PLAN, "branch": "Action:", "trajectory": CODES})
    tokens = compiled.render(values, {"plan": PLAN})
    assert target.weights == tuple(1.0 if token.section == "trajectory" else 10.0 for token in tokens)


def test_traj_only_has_no_plan() -> None:
    compiled = CompiledFormat(TRAJ_ONLY.format, VOCABULARY)
    target = make_target(TRAJ_ONLY, compiled, lesson(PLAN), PAPER_WEIGHTS)
    assert parse(compiled, VOCABULARY.decode(target.ids)) == Values.of({"trajectory": CODES})


def test_a_family_that_teaches_nothing_is_refused() -> None:
    family, compiled = replace(CF_VLA, teach=None), CompiledFormat(CF_VLA.format, VOCABULARY)
    with pytest.raises(ValueError, match="no targets for format 'cf_vla'"):
        make_target(family, compiled, lesson(PLAN), PAPER_WEIGHTS)


def test_a_counterfactual_target_does_not_teach_the_wrong_plan() -> None:
    compiled = CompiledFormat(CF_VLA.format, VOCABULARY)
    reflection = Counterfactual(WRONG, "The car ahead stands still.")
    target = make_target(CF_VLA, compiled, lesson(PLAN, reflection), PAPER_WEIGHTS)
    plans = {"plan": WRONG, "revised_plan": PLAN}
    values = parse(compiled, VOCABULARY.decode(target.ids), plans)
    assert (values["plan"], values["revised_plan"]) == (WRONG, PLAN)
    sections = [token.section for token in compiled.render(values, plans)]
    weights = {
        name: {weight for weight, section in zip(target.weights, sections, strict=True) if section == name}
        for name in set(sections)
    }
    assert weights == {
        "plan": {0.0},
        "branch": {10.0},
        "thinking": {10.0},
        "revised_plan": {10.0},
        "trajectory": {1.0},
    }


def test_a_plan_that_nobody_judged_teaches_no_branch() -> None:
    compiled = CompiledFormat(CF_VLA.format, VOCABULARY)
    told = Counterfactual(WRONG, "The car ahead stands still.")
    judged, unjudged = (
        make_target(CF_VLA, compiled, lesson(PLAN, replace(told, judged=judged)), PAPER_WEIGHTS)
        for judged in (True, False)
    )
    assert judged.ids == unjudged.ids
    plans = {"plan": WRONG, "revised_plan": PLAN}
    values = parse(compiled, VOCABULARY.decode(judged.ids), plans)
    sections = [token.section for token in compiled.render(values, plans)]
    differ = {
        section
        for section, one, other in zip(sections, judged.weights, unjudged.weights, strict=True)
        if one != other
    }
    assert differ == {"branch"}
    assert {
        weight for weight, section in zip(unjudged.weights, sections, strict=True) if section == "branch"
    } == {0.0}


def test_the_expert_may_teach_no_branch() -> None:
    compiled = CompiledFormat(CF_VLA.format, VOCABULARY)
    whole, rest = (
        make_target(CF_VLA, compiled, lesson(PLAN), PAPER_WEIGHTS, expert_branches=branches)
        for branches in (True, False)
    )
    assert whole.ids == rest.ids
    given = {"plan": PLAN}
    tokens = compiled.render(parse(compiled, VOCABULARY.decode(whole.ids), given), given)
    differ = [
        (token.section, other)
        for token, one, other in zip(tokens, whole.weights, rest.weights, strict=True)
        if one != other
    ]
    assert {section for section, _ in differ} == {"branch"}
    assert {weight for _, weight in differ} == {0.0}
    looked = lesson(PLAN, Counterfactual(WRONG, "The car ahead stands still."))
    assert make_target(CF_VLA, compiled, looked, PAPER_WEIGHTS, expert_branches=False) == make_target(
        CF_VLA, compiled, looked, PAPER_WEIGHTS
    )


def test_a_right_plan_of_its_own_is_acted_on_and_not_taught() -> None:
    compiled = CompiledFormat(CF_VLA.format, VOCABULARY)
    target = make_target(CF_VLA, compiled, lesson(PLAN, Counterfactual(WRONG, "")), PAPER_WEIGHTS)
    values = parse(compiled, VOCABULARY.decode(target.ids), {"plan": WRONG})
    assert values == Values.of({"plan": WRONG, "branch": "Action:", "trajectory": CODES})
    taught = [id for id, weight in zip(target.ids, target.weights, strict=True) if weight > 0]
    assert VOCABULARY.decode(taught).startswith("Action:")


def test_a_reflection_in_phrases_leads_to_its_own_plan() -> None:
    compiled = CompiledFormat(PHRASES, VOCABULARY)
    first, slower = three_tracks("Keep Speed", "Keep Lane"), three_tracks("Wait", "Keep Lane")
    text = str(Statement(Thing("barrier", "my lane", 20), "too close", "slower"))
    expert = three_tracks("Wait", "Left Lane Change")
    target = make_target(CF_VLA, compiled, lesson(expert, Counterfactual(first, text, slower)), PAPER_WEIGHTS)
    values = parse(compiled, VOCABULARY.decode(target.ids))
    assert (values["thinking"], values["revised_plan"]) == (text, slower)
    # The expert goes to the left, of which nothing is stated: its trajectory is not what was planned.
    tokens = compiled.render(values)
    weights = {
        token.section: weight for token, weight in zip(tokens, target.weights, strict=True) if weight != 10
    }
    assert weights == {"plan": 0.0, "trajectory": 0.0}
    same = make_target(CF_VLA, compiled, lesson(slower, Counterfactual(first, text, slower)), PAPER_WEIGHTS)
    assert same.ids == target.ids
    assert set(same.weights) == {0.0, 1.0, 10.0}


def test_a_plan_that_phrases_do_not_lead_to_is_refused() -> None:
    compiled = CompiledFormat(PHRASES, VOCABULARY)
    first, slower = three_tracks("Keep Speed", "Keep Lane"), three_tracks("Wait", "Left Lane Change")
    text = str(Statement(Thing("barrier", "my lane", 20), "too close", "slower"))
    with pytest.raises(FormatError, match="changes otherwise"):
        make_target(CF_VLA, compiled, lesson(slower, Counterfactual(first, text, slower)), PAPER_WEIGHTS)
    with pytest.raises(FormatError, match="no reflection in phrases"):
        make_target(
            CF_VLA,
            compiled,
            lesson(slower, Counterfactual(first, "I should slow down.", slower)),
            PAPER_WEIGHTS,
        )


def three_tracks(longitudinal: str, lane: str) -> Plan:
    words = {"longitudinal": longitudinal, "lateral": "Straight", "lane": lane}
    return parse_plan("".join(f"- {group}\n  - 0.0s-6.4s: {word}\n" for group, word in words.items()))


def test_every_section_needs_a_weight() -> None:
    with pytest.raises(KeyError):
        make_target(CF_VLA, CompiledFormat(CF_VLA.format, VOCABULARY), lesson(PLAN), {"plan": 1.0})
