from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from looktwice.model.driving.perceived import Perceived, PerceivedAgent
from looktwice.model.driving.plan import parse_plan
from looktwice.model.engines.engine import (
    Controls,
    Draw,
    DrawFinished,
    Engine,
    EngineError,
    Event,
    PlanRequest,
)
from looktwice.model.evaluation.draw_store import DrawStore
from looktwice.model.families.family import Attempt, Foreseen, NextPicture
from looktwice.model.network.model_card import ModelCard
from tests.model.driving.drives import labelled_scene
from tests.model.evaluation.fakes import FakeEngine, draw_of

SCENE = labelled_scene().scene
PLAN = parse_plan("- longitudinal\n  - 0.0s-3.2s: Wait\n  - 3.2s-6.4s: Accelerate\n")
PERCEIVED = Perceived((PerceivedAgent("vehicle", 9.0, 1.0, 4.5, 2.0, None),), 1.5, 4.0)
DRAFT = np.zeros((8, 4), np.float32)
ASKED = PlanRequest("a", SCENE, "cf_vla", Controls(n=3, prefill=PLAN))


def ask(engine: Engine, *requests: PlanRequest) -> list[list[Draw]]:
    async def go() -> list[list[Draw]]:
        await engine.start()
        try:
            return [
                [event.draw async for event in engine.submit(request) if isinstance(event, DrawFinished)]
                for request in requests
            ]
        finally:
            await engine.stop()

    return asyncio.run(go())


def same(some: Sequence[Draw], others: Sequence[Draw]) -> None:
    assert len(some) == len(others)
    for one, other in zip(some, others, strict=True):
        np.testing.assert_array_equal(one.trajectory, other.trajectory)
        assert vars(one) | {"trajectory": None} == vars(other) | {"trajectory": None}


def test_what_was_asked_before_is_not_asked_again(tmp_path: Path) -> None:
    file, first, again = tmp_path / "kept" / "draws.sqlite", FakeEngine(), FakeEngine()
    [made] = ask(DrawStore(first, file), ASKED)
    [found] = ask(DrawStore(again, file), replace(ASKED, request_id="by another name"))
    assert (len(first.requests), len(again.requests)) == (1, 0)
    assert len(made) == 3
    same(found, made)


class ChangingEngine(FakeEngine):
    """Takes new weights while a request waits."""

    revision = "1"

    @property
    def card(self) -> ModelCard:
        return replace(super().card, revision=self.revision)

    async def submit(self, request: PlanRequest) -> AsyncGenerator[Event]:
        self.revision = "2"
        async for event in super().submit(request):
            yield event


def test_draws_are_stored_by_the_weights_that_made_them(tmp_path: Path) -> None:
    file, old, new = tmp_path / "draws.sqlite", FakeEngine(), ChangingEngine()
    ask(DrawStore(ChangingEngine(), file), ASKED)
    new.revision = "2"
    ask(DrawStore(old, file), ASKED)
    ask(DrawStore(new, file), ASKED)
    assert (len(old.requests), len(new.requests)) == (1, 0)


def test_draws_come_back_whole(tmp_path: Path) -> None:
    whole = replace(
        draw_of(SCENE.history.repeat(4, 0).astype(np.float32), PLAN, PLAN, 2),
        text="…", think_probability=0.1, passes=7, chosen=5, cut="shortened",
        foreseen=Foreseen(PERCEIVED, 5.0, 0.5, "Left", NextPicture("back", (1, 2, 3))),
        section_logprobs={"visual": -7.5}, action=("left", "keep"),
    )  # fmt: skip

    class One(FakeEngine):
        async def submit(self, request: PlanRequest) -> AsyncGenerator[Event]:
            self.requests.append(request)
            yield DrawFinished(whole)

    asked, file = replace(ASKED, controls=Controls(n=1)), tmp_path / "draws.sqlite"
    ask(DrawStore(One(), file), asked)
    [found] = ask(DrawStore(FakeEngine(), file), asked)
    same(found, [whole])


def test_anything_else_is_asked(tmp_path: Path) -> None:
    engine, other_pictures = FakeEngine(), replace(SCENE.clips[0], images=SCENE.clips[0].images[::-1])
    others = [
        replace(ASKED, format="traj_only"),
        replace(ASKED, attempt=Attempt(DRAFT, "Brake.")),
        replace(ASKED, attempt=Attempt(DRAFT, "Brake earlier.")),
        replace(ASKED, attempt=Attempt(DRAFT + 1, "Brake.")),
        replace(ASKED, controls=replace(ASKED.controls, prefill=None)),
        replace(ASKED, controls=replace(ASKED.controls, seed=1)),
        replace(ASKED, scene=replace(SCENE, clips=(other_pictures, *SCENE.clips[1:]))),
        replace(ASKED, scene=replace(SCENE, route=np.full((20, 2), np.arange(20)[:, None], np.float32))),
    ]
    ask(DrawStore(engine, tmp_path / "draws.sqlite"), ASKED, *others)
    assert len(engine.requests) == 1 + len(others)


def test_what_did_not_come_to_its_end_is_asked_again(tmp_path: Path) -> None:
    file, engine = tmp_path / "draws.sqlite", FakeEngine(missing=1)
    ask(DrawStore(engine, file), ASKED)
    with pytest.raises(EngineError):
        ask(DrawStore(FakeEngine(broken=frozenset({SCENE.scene_id})), file), ASKED)
    whole = FakeEngine()
    ask(DrawStore(whole, file), ASKED)
    assert len(whole.requests) == 1


def test_another_file_is_left_alone(tmp_path: Path) -> None:
    (file := tmp_path / "draws.sqlite").write_text("a letter to somebody")
    with pytest.raises(ValueError, match="name another file"):
        ask(DrawStore(FakeEngine(), file), ASKED)
    assert file.read_text() == "a letter to somebody"
