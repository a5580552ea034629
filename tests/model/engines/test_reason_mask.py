"""Reflections that state only what the view gives a reason for, as the engine writes them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.facts import FACTS
from looktwice.model.driving.phrases import HEADS, NOTHING, Statement, read_facts
from looktwice.model.driving.tracks import Track
from looktwice.model.engines.engine import Controls, PlanRequest, RequestError
from looktwice.model.engines.reason_mask import ReasonMask, reason_mask_of
from looktwice.model.engines.torch.decoder import Decoder
from looktwice.model.engines.torch.runner import Runner
from looktwice.model.families.cf_vla import CF_VLA
from looktwice.model.families.cf_vla.traj_only import TRAJ_ONLY
from looktwice.model.formats.cursor import CompiledFormat, Token
from looktwice.model.formats.phrase_pieces import Phrases
from looktwice.model.formats.pieces import Format, Section, Sequence
from looktwice.model.formats.pieces import Literal as Text
from looktwice.model.network.checkpoint import Loaded, load
from tests.checkpoints import noisy_scene
from tests.model.driving.strategies import facts
from tests.model.engines.decoding import decode, request
from tests.model.engines.reference import exactly, reference_draws

REASONS = st.lists(facts(), max_size=3).map(
    lambda made: frozenset(each for some in made for each in some.statements)
)
TRACKS = (
    Track(18.0, 0.0, 0.0, 0.0, 4.5, 1.9, "vehicle"),
    Track(40.0, 3.5, 0.0, 4.0, 4.5, 1.9, "vehicle", frozenset({"brake"})),
    Track(20.0, -6.5, 1.6, 1.0, 0.6, 0.6, "pedestrian"),
)


@pytest.fixture(scope="module")
def phrased(resampling_checkpoint: Path) -> Loaded:
    return exactly(load(resampling_checkpoint, dtype=torch.float64))


def tracked(name: str, scene: int, **controls: Any) -> PlanRequest:
    asked = request(name, scene, **controls)
    return replace(asked, scene=replace(asked.scene, tracks=TRACKS))


def stated(thinking: str | None) -> set[str]:
    assert thinking is not None
    return set(map(str, read_facts(thinking).statements))


@pytest.mark.usefixtures("inference")
def test_reflections_state_only_what_has_a_reason(phrased: Loaded) -> None:
    """At a temperature at which nearly anything is written."""
    requests = [
        ask(f"{k}{ask.__name__}", k, n=6, seed=k, thinking="always", temperature=2.0)
        for k in range(4)
        for ask in (request, tracked)
    ]
    draws = decode(Decoder(Runner(phrased, 16)), *requests)
    said = [stated(draw.thinking) for draw in draws.values()]
    for draw, statements in zip(draws.values(), said, strict=True):
        assert draw.reasons is not None
        assert statements <= set(draw.reasons)
    assert sum(map(len, said)) > 8
    free = decode(
        Decoder(Runner(phrased, 16)),
        *(replace(each, controls=replace(each.controls, reasons="any")) for each in requests),
    )
    assert any(not stated(free[key].thinking) <= set(draw.reasons or ()) for key, draw in draws.items())
    assert {draw.reasons for draw in free.values()} == {None}


@pytest.mark.usefixtures("inference")
def test_masked_requests_decode_as_the_reference_does(phrased: Loaded) -> None:
    mixed = [
        tracked("tracks", 1, n=3, seed=5, thinking="always", temperature=1.5),
        request("pictures", 2, n=3, seed=6, thinking="always", temperature=1.5),
        request("any", 2, n=2, seed=6, thinking="always", reasons="any"),
        request("bare", 3, "traj_only", n=2),
    ]
    draws = decode(Decoder(Runner(phrased, 16)), *mixed)
    for asked in mixed:
        for expected in reference_draws(phrased, asked):
            assert draws[asked.request_id, expected.index].text == expected.text


@given(REASONS, st.lists(st.integers(0, 2**16), min_size=40, max_size=40))
def test_every_walk_ends_and_states_nothing_else(
    phrased: Loaded, reasons: frozenset[Statement], turns: list[int]
) -> None:
    body = Section("why", Sequence((Phrases(), Text("\n"))))
    compiled = CompiledFormat(Format("walk", body), phrased.vocabulary)
    mask = ReasonMask(lambda: reasons, "why", phrased.vocabulary)
    cursor, written = compiled.start(), list[Token]()
    for turn in turns:
        run, cursor = cursor.forced()
        written += run
        if cursor.done:
            break
        ids, left = cursor.allowed().ids, mask.leaves(cursor, written)
        ids = ids if left is None else ids[left]
        assert len(ids)
        written.append(Token(int(ids[turn % len(ids)]), "why"))
        cursor = cursor.advance(written[-1].id)
    assert cursor.done
    facts = read_facts(phrased.vocabulary.decode([token.id for token in written]).strip())
    assert set(facts.statements) <= reasons


def test_where_nothing_is_in_view_nothing_is_said(phrased: Loaded) -> None:
    compiled = CompiledFormat(
        Format("walk", Section("why", Sequence((Phrases(), Text("\n"))))), phrased.vocabulary
    )
    start = compiled.start()
    left = ReasonMask(tuple, "why", phrased.vocabulary).leaves(start, [])
    assert left is not None
    (token,) = start.allowed().ids[left]
    assert NOTHING.startswith(phrased.vocabulary.decode([int(token)]))
    assert len(start.allowed().ids) > len(HEADS) // 2


def test_who_knows_nothing_or_writes_no_phrases_is_not_masked(phrased: Loaded) -> None:
    vocabulary, facts = phrased.vocabulary, np.zeros(len(FACTS), np.float32)
    asked, phrases = (
        PlanRequest("a", noisy_scene(), "cf_vla", controls=Controls()),
        CF_VLA.in_dialect("phrases"),
    )
    tracked_one = replace(asked, scene=replace(asked.scene, tracks=()))
    assert reason_mask_of(asked, phrases, vocabulary, None) is None
    assert reason_mask_of(asked, phrases, vocabulary, facts) is not None
    for family in (CF_VLA.in_dialect("free_text"), TRAJ_ONLY):
        assert reason_mask_of(tracked_one, family, vocabulary, facts) is None
    free = replace(tracked_one, controls=Controls(reasons="any"))
    assert reason_mask_of(free, phrases, vocabulary, facts) is None
    mask = reason_mask_of(tracked_one, phrases, vocabulary, None)
    assert mask is not None
    assert set(mask.statements) == {
        "My lane is clear. Going on like this would be needlessly cautious, so I should pick up speed.",
        "My lane is clear. Going on like this would be unnecessary, so I should stay in my lane.",
        "The road runs straight on. Going on like this would carry me out of the lane, so I should "
        "steer straight for longer.",
    }


def test_other_values_are_refused() -> None:
    with pytest.raises(RequestError, match="reasons must be in_view or any"):
        Controls(reasons="all")  # type: ignore[arg-type]
