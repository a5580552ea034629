"""A build by outcomes with the shipped checkpoint: real scenes, a real service, plans followed for real."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from looktwice.clients.labelling.build_outcomes import Followed
from looktwice.clients.labelling.ledger import FILE, Ledger
from looktwice.model.bundled import CHECKPOINT, SCENES
from looktwice.model.driving.reflection_store import read_reflections
from looktwice.model.driving.scene_store import MANIFEST
from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.service.operations.settings import Settings
from tests.service.cli.builds import ran, told
from tests.service.serving import serve

DRAWS = 2


@pytest.fixture(scope="module")
def rolled(generated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A build whose scenes are rolled out."""
    folder = tmp_path_factory.mktemp("build")
    with serve(TorchEngine(CHECKPOINT, TorchSettings(rows=24)), Settings()) as served:
        done = told("rollout", folder, generated, "--service", served.url, "--n", DRAWS, "--json")
        bundled = told("rollout", folder, SCENES, "--service", served.url, "--n", DRAWS, "--json")
    assert (done["dead"], bundled["dead"]) == (0, 0)
    assert done["done"] >= 6
    return folder


def scenes_of(manifest_of: Path) -> int:
    return int(json.loads((manifest_of / MANIFEST).read_text())["scenes"])


def test_from_outcomes_to_examples(rolled: Path, generated: Path, tmp_path: Path) -> None:
    build, count = tmp_path / "build", scenes_of(generated)
    shutil.copytree(rolled, build)
    shown = ran("outcomes", build, generated, "--workers", 1, "--dry-run", 1)
    assert shown.count('"collided_s"') == 1 + DRAWS
    first = told("outcomes", build, generated, "--workers", 1, "--limit", 2, "--json")
    assert (first["done"], first["earlier"], first["scenes"]) == (2, 0, 2)
    done = told("outcomes", build, generated, "--workers", 2, "--json")
    assert (done["done"], done["earlier"], done["dead"]) == (count - 2, 2, 0)
    assert done["plans"] == DRAWS * count
    assert done["expert_holds"] == count
    assert 0 < done["plans_hold"] < done["plans"]
    assert 0 < sum(done["mends"].values()) <= done["plans"] - done["plans_hold"]
    kept = told("filter", build, "--outcomes", "--json")
    assert kept["scenes"] == count
    assert 0 < kept["plans"] <= done["plans"] - done["plans_hold"]
    assert (build / "filter.png").read_bytes()[:4] == b"\x89PNG"
    labels = told("label", build, generated, "--plans-per-scene", DRAWS, "--json")
    assert labels["done"] + labels["dead"] == kept["plans"]
    ran("export", build, "--to", tmp_path / "r.parquet", "--right-outcomes")
    written = list(read_reflections(tmp_path / "r.parquet"))
    held = [each for each in written if not each.reflection]
    assert len(written) - len(held) == labels["done"]
    assert 0 < len(held) <= done["plans_hold"]
    assert {bool(each.mend) for each in held} == {False}
    assert all(each.mend for each in written if each.reflection)
    corrected = {(each.scene_id, str(each.predicted_plan)) for each in written if each.reflection}
    assert corrected.isdisjoint({(each.scene_id, str(each.predicted_plan)) for each in held})


def test_killed_at_any_moment_it_goes_on_with_the_same_outcomes(
    rolled: Path, generated: Path, tmp_path: Path
) -> None:
    build, whole = tmp_path / "build", tmp_path / "whole"
    shutil.copytree(rolled, build)
    shutil.copytree(rolled, whole)
    arguments = ("outcomes", build, generated, "--workers", 1, "--json")
    process = subprocess.Popen(
        [sys.executable, "-m", "looktwice.service.cli", "build", *map(str, arguments)], start_new_session=True
    )
    while count_outcomes(build) == 0:
        assert process.poll() is None, "it was to be killed in the middle"
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    # Its workers end with it: a process group without processes cannot be signalled.
    while True:
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:
            break
        time.sleep(0.05)
    before = count_outcomes(build)
    rest = told(*arguments)
    assert (rest["done"], rest["earlier"]) == (scenes_of(generated) - before, before)
    told("outcomes", whole, generated, "--workers", 2, "--json")
    assert outcomes_in(build) == outcomes_in(whole)


def count_outcomes(build: Path) -> int:
    copy = build.parent / "looked-at"
    copy.mkdir(exist_ok=True)
    (copy / FILE).unlink(missing_ok=True)
    Ledger.copy(build, copy)
    return len(outcomes_in(copy))


def outcomes_in(build: Path) -> dict[str, Followed]:
    with Ledger(build) as ledger:
        return {
            entry.scene_id: Followed.of(entry.record)
            for run in ledger.runs("outcomes")
            for entry in ledger.entries(run)
        }


def test_what_cannot_be_followed_is_refused_by_name(rolled: Path, generated: Path, tmp_path: Path) -> None:
    assert "imported and bundled ones have none" in ran("outcomes", rolled, SCENES, code=2)
    assert "looktwice build outcomes" in ran("filter", rolled, "--outcomes", code=2)
    assert "no --epsilon" in ran("filter", rolled, "--outcomes", "--epsilon", 2, code=2)
    target = tmp_path / "x.parquet"
    assert "or --right-outcomes" in ran(
        "export", rolled, "--to", target, "--right-iou", 0.7, "--right-outcomes", code=2
    )
    # The same files with a manifest that lies: nothing is entered but dead letters.
    lying, build = tmp_path / "lying", tmp_path / "build"
    shutil.copytree(generated, lying)
    shutil.copytree(rolled, build)
    manifest = json.loads((lying / MANIFEST).read_text())
    manifest["config"]["duration_s"] = 40.0
    (lying / MANIFEST).write_text(json.dumps(manifest))
    refused = told("outcomes", build, lying, "--workers", 1, "--max-error-rate", 1, "--json")
    assert (refused["done"], refused["dead"]) == (0, scenes_of(generated))
    assert "went otherwise" in (build / "dead_letters.jsonl").read_text()
