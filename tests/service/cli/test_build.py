"""The whole build with the shipped checkpoint: a real service, real scenes, real commands."""

from __future__ import annotations

import asyncio
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from looktwice.clients.labelling.ledger import StageRun
from looktwice.clients.retries import TryLater, with_retries
from looktwice.model.bundled import CHECKPOINT, SCENES
from looktwice.model.driving.phrases import agrees, read_facts
from looktwice.model.driving.reflection_store import read_reflections, write_reflections
from looktwice.model.driving.scene_store import read_scenes, write_scenes
from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.model.network.checkpoint import read_config
from looktwice.model.network.vla_settings import VlaSettings
from looktwice.service.cli.commands import app
from looktwice.service.cli.stages import progress_bar
from looktwice.service.operations.settings import Settings
from tests.clients.labelling.builds import GOOD, LEAKING, ChatServer
from tests.service.cli.builds import ran, told
from tests.service.serving import serve
from tests.sockets import listening

COUNT = 12


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    with serve(TorchEngine(CHECKPOINT, TorchSettings(rows=24)), Settings()) as served:
        yield served.url


@pytest.fixture(scope="module")
def unlabelled(url: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A build whose scenes are rolled out and all kept; not to be changed."""
    folder = tmp_path_factory.mktemp("build") / "unlabelled"
    done = told("rollout", folder, SCENES, "--service", url, "--n", 2, "--json")
    assert (done["done"], done["dead"]) == (COUNT, 0)
    assert told("filter", folder, "--everything", "--json")["kept"] == COUNT
    return folder


@pytest.fixture(scope="module")
def rolled(unlabelled: Path) -> Path:
    """The same, for tests that go on where others ended."""
    return Path(shutil.copytree(unlabelled, unlabelled.with_name("rolled")))


def test_rolled_out_once_and_for_all(rolled: Path, url: str) -> None:
    again = told("rollout", rolled, SCENES, "--service", url, "--n", 2, "--json")
    assert (again["done"], again["earlier"]) == (0, COUNT)
    assert (rolled / "filter.png").read_bytes()[:4] == b"\x89PNG"


def test_of_some_scenes_only(rolled: Path, tmp_path: Path) -> None:
    some = tmp_path / "some.parquet"
    write_scenes(some, islice(read_scenes(SCENES), 3))
    build = tmp_path / "build"
    shutil.copytree(rolled, build)
    kept = told("filter", build, some, "--everything", "--json")
    assert (kept["scenes"], kept["kept"]) == (3, 3)
    assert "does not exist" in ran("filter", build, tmp_path / "none", code=2)


def test_labelled_and_exported_in_every_form(rolled: Path, tmp_path: Path) -> None:
    done = told("label", rolled, SCENES, "--json")
    written = done["done"]
    # Of a scene in which nothing asks for another plan the built-in teacher writes nothing.
    assert (written + done["dead"], done["answers"]) == (COUNT, written)
    assert written > COUNT / 2
    run = done["run"][:8]
    ran("export", rolled, "--to", tmp_path / "r.parquet", "--run", run)
    assert len(list(read_reflections(tmp_path / "r.parquet"))) == written
    ran("export", rolled, "--form", "messages", "--scenes", SCENES, "--to", tmp_path / "m", "--run", run)
    assert len((tmp_path / "m" / "messages.jsonl").read_text().splitlines()) == written
    assert "--scenes" in ran("export", rolled, "--form", "messages", "--to", tmp_path / "n", code=2)


def test_a_model_of_phrases_learns_from_its_own_plans(resampling_checkpoint: Path, tmp_path: Path) -> None:
    build, file = tmp_path / "build", tmp_path / "reflections.parquet"
    with serve(TorchEngine(resampling_checkpoint, TorchSettings(rows=12)), Settings()) as served:
        told("rollout", build, SCENES, "--service", served.url, "--n", 2, "--json")
    told("filter", build, "--everything", "--json")
    assert told("label", build, SCENES, "--json")["done"] > 0
    ran("export", build, "--to", file)
    written = list(read_reflections(file))
    for each in written:
        assert agrees(read_facts(each.reflection), each.predicted_plan, each.expert_plan)
    learned = trained(resampling_checkpoint, file, tmp_path / "learned")
    assert learned.exit_code == 0, learned.output
    assert VlaSettings.of_config(read_config(tmp_path / "learned")).reflection == "phrases"

    free = [replace(each, reflection="A car brakes ahead, so I should slow down.") for each in written]
    write_reflections(file, free)
    refused = trained(resampling_checkpoint, file, tmp_path / "no")
    assert refused.exit_code == 2
    assert "'A car brakes ahead, so I should slow down.' is no reflection in phrases" in refused.output
    assert not (tmp_path / "no").exists()


def trained(source: Path, reflections: Path, target: Path) -> Result:
    """A few steps of counterfactual training."""
    options = {
        "--scenes": SCENES,
        "--from": source,
        "--to": target,
        "--reflections": reflections,
        "--cache": target.parent / "cache",
        "--steps": 2,
        "--batch-size": 2,
    }
    arguments = [str(each) for option in options.items() for each in option]
    return CliRunner().invoke(app, ["train", "counterfactual", *arguments])


FULL = """
import resource
from looktwice.clients.labelling.ledger import Ledger
from looktwice.service.cli.commands import app

entered = Ledger.__enter__


def fill(ledger):
    resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))
    return entered(ledger)


Ledger.__enter__ = fill
app()
"""


def stopped_by_a_full_disk(limit_bytes: int, *arguments: object) -> str:
    """What `build` says where, once its ledger is open, no file may grow beyond so many bytes."""
    code = FULL.format(limit=limit_bytes)
    command = [sys.executable, "-c", code, "build", *map(str, arguments)]
    stopped = subprocess.run(command, capture_output=True, text=True, check=False)
    assert stopped.returncode == 2, stopped.stderr
    assert "Traceback" not in stopped.stderr
    last = stopped.stderr.splitlines()[-1]
    assert last.startswith("looktwice: ")
    return last


def test_a_full_disk_stops_labels_with_a_message_and_loses_none(unlabelled: Path, tmp_path: Path) -> None:
    build = tmp_path / "build"
    shutil.copytree(unlabelled, build)
    # Full after a few labels.
    stopped_by_a_full_disk(40_000, "label", build, SCENES, "--seed", 7)
    done = told("label", build, SCENES, "--seed", 7, "--json")
    assert done["done"] + done["dead"] + done["earlier"] == COUNT
    assert done["done"] > 0


def test_a_full_disk_stops_a_rollout_with_a_message_and_loses_nothing(url: str, tmp_path: Path) -> None:
    rollout = ("rollout", tmp_path / "build", SCENES, "--service", url, "--n", 2)
    # Full after a few scenes.
    stopped_by_a_full_disk(100_000, *rollout)
    done = told(*rollout, "--json")
    assert done["done"] + done["earlier"] == COUNT
    assert done["done"] > 0


def test_a_full_disk_stops_a_filter_with_a_message(unlabelled: Path, tmp_path: Path) -> None:
    build = tmp_path / "build"
    shutil.copytree(unlabelled, build)
    stopped_by_a_full_disk(100, "filter", build)
    picture = build / "filter.png"
    picture.unlink()
    picture.symlink_to("/dev/full")
    assert "No space left" in ran("filter", build, "--everything", code=2)
    picture.unlink()
    assert told("filter", build, "--everything", "--json")["kept"] == COUNT


@pytest.mark.parametrize("form", ["parquet", "messages", "openai-batch"])
def test_a_full_disk_stops_an_export_with_a_message(
    unlabelled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str
) -> None:
    for name, value in {"KIND": "openai", "MODEL": "batched"}.items():
        monkeypatch.setenv(f"LOOKTWICE_TEACHER_{name}", value)
    build, folder = tmp_path / "build", tmp_path / "made"
    shutil.copytree(unlabelled, build)
    with monkeypatch.context() as built_in:
        built_in.setenv("LOOKTWICE_TEACHER_KIND", "rules")
        assert told("label", build, SCENES, "--seed", 8, "--json")["done"] > 0
    scenes = () if form == "parquet" else ("--scenes", SCENES)
    export = ("export", build, "--form", form, *scenes, "--to", folder / "made")
    ran(*export)  # so that nothing is left to be told to the ledger
    shutil.rmtree(folder)
    assert "File too large" in stopped_by_a_full_disk(100, *export)
    left = [path for path in folder.rglob("*") if path.is_file() and path.parent.name != "images"]
    assert not left, "what was not finished must not look so; pictures are written over"


def test_labelled_by_the_service(rolled: Path, url: str) -> None:
    arguments = ("--teacher", "service", "--service", url, "--seed", 1, "--json")
    done = told("label", rolled, SCENES, *arguments)
    assert done["done"] > COUNT / 2
    assert done["done"] + done["dead"] == COUNT


def test_labelled_by_an_endpoint(rolled: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    server = ChatServer([LEAKING])
    with listening(server.app()) as (url, _):
        for name, value in {"KIND": "openai", "BASE_URL": f"{url}/v1", "MODEL": "some-vlm"}.items():
            monkeypatch.setenv(f"LOOKTWICE_TEACHER_{name}", value)
        done = told("label", rolled, SCENES, "--limit", 3, "--max-error-rate", 1, "--json")
    assert (done["done"], done["dead"], done["answers"]) == (0, 3, 9)
    assert (done["input_tokens"], done["output_tokens"]) == (9000, 450)
    letters = [json.loads(line) for line in (rolled / "dead_letters.jsonl").read_text().splitlines()]
    # The built-in teacher's silence left letters without a text.
    assert [letter["text"] for letter in letters if "text" in letter] == [LEAKING] * 3


def test_a_limit_is_of_new_work(rolled: Path) -> None:
    tallies = [told("label", rolled, SCENES, "--seed", 5, "--limit", 2, "--json") for _ in range(2)]
    assert [(each["done"] + each["dead"], each["earlier"]) for each in tallies] == [(2, 0), (2, 2)]
    shown = ran("label", rolled, SCENES, "--seed", 5, "--dry-run", 2)
    assert shown.count('"scene_id"') == 2


def test_a_dry_run_keeps_nothing(rolled: Path, url: str, tmp_path: Path) -> None:
    folder = tmp_path / "empty"
    shown = ran("rollout", folder, SCENES, "--service", url, "--n", 2, "--dry-run", 2)
    assert shown.count('"expert_plan"') == 2
    assert not folder.exists()
    shown = ran("label", rolled, SCENES, "--seed", 9, "--dry-run", 2)
    assert shown.count('"reflection"') == 2
    assert "several runs of label" in ran("export", rolled, "--to", tmp_path / "x.parquet", code=2)


def test_a_batch_goes_out_and_its_results_come_in(
    rolled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"KIND": "openai", "MODEL": "batched"}.items():
        monkeypatch.setenv(f"LOOKTWICE_TEACHER_{name}", value)
    asked = tmp_path / "asked.jsonl"
    ran("export", rolled, "--form", "openai-batch", "--scenes", SCENES, "--to", asked)
    lines = [json.loads(line) for line in asked.read_text().splitlines()]
    assert len(lines) == COUNT
    answered = tmp_path / "answered.jsonl"
    body = {"choices": [{"message": {"content": GOOD}, "finish_reason": "stop"}]}
    answered.write_text(
        "".join(
            json.dumps({"custom_id": line["custom_id"], "response": {"status_code": 200, "body": body}})
            + "\n"
            for line in lines
        )
    )
    taken = told("take", rolled, SCENES, answered, "--json")
    # The same words fit the change that some scenes want and not that of others.
    asked_again = ran("export", rolled, "--form", "openai-batch", "--scenes", SCENES, "--to", asked)
    assert f"{COUNT - taken['done']} written" in asked_again


def test_waiting_is_told_beside_the_bar_alone(capsys: pytest.CaptureFixture[str]) -> None:
    refusals = iter([TryLater("busy", 0.0), TryLater("busy", 0.0)])

    async def answer() -> str:
        for refusal in refusals:
            raise refusal
        return "done"

    with progress_bar(StageRun("id", "rollout", {}), 1, quiet=False):
        assert asyncio.run(with_retries(answer, 10.0)) == "done"
    told = capsys.readouterr()
    assert told.out == ""
    assert "waiting: busy" in told.err


def test_mistakes_are_told_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "no service answers" in ran("rollout", tmp_path, SCENES, "--service", "http://127.0.0.1:9", code=2)
    assert "no rollout yet" in ran("filter", tmp_path, code=2)
    assert "no rollout yet" in ran("label", tmp_path, SCENES, code=2)
    monkeypatch.setenv("LOOKTWICE_TEACHER_KIND", "openai")
    arguments = ("--form", "openai-batch", "--scenes", SCENES, "--to", tmp_path / "x")
    assert "LOOKTWICE_TEACHER" in ran("export", tmp_path, *arguments, code=2)
