"""VLA-World perceives, predicts, imagines or does not, thinks and acts: in the engine and over HTTP."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import clients.wire as wire
from clients.planner import PlannerClient
from model.engines.engine import Controls, Draw, PlanRequest
from model.engines.torch.decoder import Decoder
from model.engines.torch.engine import TorchEngine, TorchSettings
from model.engines.torch.runner import Runner
from model.evaluation.open_loop import evaluate_draws
from model.families.vla_world import VLA_WORLD
from model.families.vla_world.format import TIMES_S, UNSEEN, VISUAL_CODES
from model.formats.cursor import CompiledFormat
from model.formats.grammar_export import to_lark
from model.network.checkpoint import Loaded, load, save
from model.network.settings import VlaSettings
from service.settings import Settings
from tests.checkpoints import noisy_scene, write_untrained
from tests.model.driving.drives import labelled_scene
from tests.model.engines.decoding import decode
from tests.model.engines.reference import exactly, reference_draws
from tests.model.evaluation.fakes import draw_of
from tests.service.serving import serve

CODE = re.compile(r"<\|visual_\d{4}\|>")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small one: metres as one token each; it imagines about as often as it does not."""
    settings = VlaSettings(name="world", formats=("vla_world",), reflection="phrases")
    folder = tmp_path_factory.mktemp("world") / "checkpoint"
    loaded = load(write_untrained(folder, narrow=True, settings=settings))
    network: Any = loaded.model
    with torch.no_grad():
        # Narrow ones are prone to end lines.
        network.get_input_embeddings().weight[loaded.vocabulary.encode(UNSEEN)[0]] /= 6
    save(folder, loaded.model, loaded.vocabulary, loaded.codec)
    return folder


@pytest.fixture(scope="module")
def world(checkpoint: Path) -> Loaded:
    return exactly(load(checkpoint, torch.float64))


def planned(world: Loaded, **controls: Any) -> list[Draw]:
    """What the engine writes, which is what the reference writes."""
    asked = PlanRequest("a", noisy_scene(1, route=True), "vla_world", Controls(**controls))
    with torch.inference_mode():
        draws = decode(Decoder(Runner(world, 2 * asked.controls.n), clock=lambda: 0.0), asked)
        expected = reference_draws(world, asked)
    found = [draws["a", index] for index in range(asked.controls.n)]
    assert [(draw.text, draw.tokens) for draw in found] == [(draw.text, draw.tokens) for draw in expected]
    for draw, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(draw.trajectory, theirs.trajectory)
    return found


def test_it_writes_what_the_reference_does(world: Loaded) -> None:
    draws = planned(world, n=6, numbers="drawn", seed=3)
    # Both ways are taken, or this test says less than it should.
    assert {"visual" in draw.tokens for draw in draws} == {True, False}
    for draw in draws:
        assert draw.trajectory.shape == (6, 4)
        assert (draw.times_s, draw.plan, draw.branch, draw.codes) == (TIMES_S, None, None, ())
        assert len(CODE.findall(draw.text)) == (VISUAL_CODES if "visual" in draw.tokens else 0)
        assert (draw.thinking is None) == ("<think></think>" in draw.text)
        assert {"perception", "prediction", "imagine", "think", "action", "answer"} <= set(draw.tokens)


def test_waypoints_of_least_error_are_expected_ones(world: Loaded) -> None:
    # An untrained model expects about the middle of each grid, which is far from what it would draw.
    drawn, expected = (planned(world, n=2, numbers=each) for each in ("drawn", "least_error"))
    apart = [np.abs(draw.trajectory[:, 0] - 35).mean() for draw in (*drawn, *expected)]
    assert max(apart[2:]) < 20 < min(apart[:2])


def test_it_plans_over_http_and_is_evaluated(checkpoint: Path) -> None:
    labelled = labelled_scene(12.0, pictures=1)
    engine = TorchEngine(checkpoint, TorchSettings(rows=8, products=None))
    draws = []
    with serve(engine, Settings()) as served, PlannerClient(served.url) as planner:
        for seed in range(3):
            controls = wire.Controls(n=8, temperature=1.5, numbers="drawn", seed=seed)
            # The engine parses what it wrote: an invalid response is no answer.
            draws += planner.plan(labelled.scene, controls, format="vla_world").draws
    assert len(draws) == 24
    for each in draws:
        assert (each.times_s, each.branch, each.plan) == (TIMES_S, None, None)
        assert each.thinking is None or each.thinking.startswith("Notable Objects: ")
    assert any("visual" in each.tokens for each in draws)
    told = [replace(draw_of(each.trajectory), times_s=each.times_s) for each in draws]
    expert = labelled.future[[4, 9, 14, 19, 24, 29], :2]
    apart = np.linalg.norm([draw.trajectory[:, :2] - expert for draw in told], axis=-1)
    assert evaluate_draws(labelled, told).avg_ade_m == pytest.approx(apart.mean(), rel=1e-4)


@pytest.mark.parametrize("reflection", ["phrases", "free_text"])
def test_a_grammar_can_be_exported(world: Loaded, reflection: Any) -> None:
    compiled = CompiledFormat(VLA_WORLD.in_dialect(reflection).format, world.vocabulary)
    assert "start:" in to_lark(compiled.start())
