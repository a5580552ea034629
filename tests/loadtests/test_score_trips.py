"""Scores over HTTP, of a real service without a model."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest
from typer.testing import CliRunner

from looktwice.clients.planner import PlannerClient
from looktwice.loadtests.overhead import NoAnswer
from looktwice.loadtests.score_trips import score_ms, score_request
from looktwice.model.bench.scoring_speed import scene
from looktwice.model.driving.pdm.scoring import Others, score
from looktwice.service.cli.commands import app
from looktwice.service.operations.no_model import NoModel
from looktwice.service.operations.settings import Settings
from tests.service.serving import Served, serve
from tests.sockets import PATIENCE_S


@pytest.fixture(scope="module")
def scorer() -> Iterator[Served[NoModel]]:
    with serve(NoModel(), Settings()) as running:
        running.http.timeout = 4 * PATIENCE_S
        yield running


def test_a_world_is_scored_over_http_as_it_is_here(scorer: Served[NoModel]) -> None:
    world, plans = scene(40)
    here = score(world, plans, "v2.2", Others(reference=plans[0]))
    with PlannerClient(scorer.url) as planner:
        told = planner.score(score_request(world, plans))
    assert told.missing == list(here.missing)
    assert [each.partial_score for each in told.scores] == pytest.approx(here.partial_score.tolist())


def test_what_is_refused_is_no_time(scorer: Served[NoModel]) -> None:
    world, plans = scene(1)
    asked = score_request(world, plans)
    assert score_ms(scorer.http, asked, 2) > 0
    refused = asked.model_copy(update={"reference": [[0.0, 0.0, 0.0]] * 9})
    with pytest.raises(NoAnswer, match="422"):
        score_ms(scorer.http, refused, 2)


def test_the_command_tells_what_a_service_takes(scorer: Served[NoModel]) -> None:
    asked = ["bench", "score", "--repeats", "1", "--service"]
    told = CliRunner().invoke(app, [*asked, scorer.url, "--json"])
    assert told.exit_code == 0, told.output
    assert json.loads(told.stdout)["http_6_ms"] > 0
    nobody = CliRunner().invoke(app, [*asked, "http://127.0.0.1:1"])
    assert nobody.exit_code == 2
    assert "no service answers at http://127.0.0.1:1" in nobody.output
