"""Rollout and labelling on a local Ray, against a real service."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import ray

from clients.labelling import label
from clients.labelling.ledger import Ledger
from clients.labelling.on_ray import Chunk, LabelWork, RolloutWork, chunks, work_on_ray
from clients.labelling.pipeline import Limits, StageStopped
from clients.labelling.rollout import Sampling, config_of
from clients.labelling.teachers.rules import RuleTeacher
from clients.wire import ModelName
from model.driving.scene_store import write_scenes
from service.settings import Settings
from tests.clients.labelling.builds import MODEL, named
from tests.service.scenes import labelled
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import serve

LIMITS = Limits(at_once=4, give_up_after_s=10.0)
FILES, EACH = 3, 4
# Ray warns of its own use of what it deprecates, and leaves files for its own processes to close.
pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, one = tmp_path_factory.mktemp("scenes"), labelled("scene")
    for file in range(FILES):
        write_scenes(
            folder / f"{file}.parquet", (named(one, f"scene-{file}-{number}") for number in range(EACH))
        )
    return folder


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    settings = Settings(bundled_scenes=tmp_path_factory.mktemp("none") / "none")
    with serve(ScriptedEngine(), settings) as served:
        yield served.url
    ray.shutdown()


def test_rolled_out_and_labelled_by_workers(scenes: Path, url: str, tmp_path: Path) -> None:
    with Ledger(tmp_path) as ledger:
        run = ledger.run("rollout", config_of(MODEL, Sampling(n=2)))
        work = RolloutWork(run, url, MODEL, Sampling(n=2), LIMITS)
        first = work_on_ray(ledger, run, chunks(ledger, run, scenes), work, "local")
        assert (first.done, first.dead, first.earlier) == (FILES * EACH, 0, 0)
        again = work_on_ray(ledger, run, chunks(ledger, run, scenes), work, "local")
        assert (again.done, again.earlier) == (0, FILES * EACH)

        keys = [entry.key for entry in ledger.entries(run)][: EACH + 1]
        ledger.keep(run, [(key, (0, 1)) for key in keys])
        labels = ledger.run("label", label.config_of(run, RuleTeacher(), 0))
        asking = LabelWork(labels, run, RuleTeacher, 1, 0, LIMITS)
        parts = list(chunks(ledger, labels, scenes, run))
        assert len(parts) == 2, "row groups without kept scenes are not looked at"
        done = work_on_ray(ledger, labels, iter(parts), asking, "local")
        assert (done.done, done.dead) == (EACH + 1, 0)
        assert {entry.record["rollout"] for entry in ledger.entries(labels)} == set(keys)
        assert ledger.spent(labels).answers == EACH + 1


def test_what_others_did_stays_when_a_worker_stops(scenes: Path, url: str, tmp_path: Path) -> None:
    with Ledger(tmp_path) as ledger:
        newer = ModelName(name="scripted", revision="r2")
        run = ledger.run("rollout", config_of(newer, Sampling(n=2)))
        work = RolloutWork(run, url, newer, Sampling(n=2), LIMITS)
        with pytest.raises(StageStopped, match="instead of r2"):
            work_on_ray(ledger, run, chunks(ledger, run, scenes), work, "local")
        assert ledger.count(run) == 0


def test_what_is_taken_over_twice_counts_once(tmp_path: Path) -> None:
    with Ledger(None) as helper, Ledger(tmp_path) as ledger:
        run = ledger.run("rollout", {})
        helper.run("rollout", {})
        helper.finish(run, "a", "scene a", {"x": 1})
        helper.bury(run, "b", "scene b", "no")
        for _ in range(2):
            ledger.take_over(run, helper.entered(run))
        assert (ledger.count(run), ledger.count(run, "dead")) == (1, 1)
        assert set(ledger.keys_of(run, ["scene a", "scene b", "scene c"])) == {"a", "b"}


def test_nothing_to_do_starts_no_cluster(tmp_path: Path) -> None:
    with Ledger(tmp_path) as ledger:
        run = ledger.run("rollout", {})
        work = RolloutWork(run, "http://127.0.0.1:9", MODEL, Sampling(), LIMITS)
        nothing: Iterator[Chunk] = iter(())
        assert work_on_ray(ledger, run, nothing, work, "local").done == 0
