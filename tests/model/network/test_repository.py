from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from typer.testing import CliRunner

from looktwice.model.bundled import CHECKPOINT, CHECKPOINTS, SCENES
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.families.registry import family_named
from looktwice.model.network.card import CheckpointError, read_card
from looktwice.model.network.chat_prompt import chat_template, prompt_text
from looktwice.model.network.checkpoint import load, read_parts
from looktwice.model.network.processor import LookTwiceProcessor
from looktwice.model.network.repository import write_repository
from looktwice.model.network.vla_settings import VlaSettings
from looktwice.service.cli.commands import app
from tests.checkpoints import write_untrained
from tests.sockets import listening

# In a process of its own: `transformers` keeps what it loads from a folder's code for the whole process.
LOADED_BY_NAME = """
import sys
from safetensors.torch import save_file
from transformers import AutoModel, AutoModelForImageTextToText, AutoProcessor
from looktwice.model.bundled import SCENES
from looktwice.model.driving.scene_store import read_scenes

folder, out = sys.argv[1:]
processor = AutoProcessor.from_pretrained(folder, trust_remote_code=True)
inputs = processor(next(read_scenes(SCENES)).scene)
for auto in (AutoModel, AutoModelForImageTextToText):
    model, report = auto.from_pretrained(folder, trust_remote_code=True, output_loading_info=True)
    assert not report["missing_keys"] and not report["unexpected_keys"], report
    logits = model.eval()(**inputs).logits
save_file({"logits": logits}, out)
"""


def run(
    code: str, *arguments: object, home: Path, hub: str | None = None
) -> subprocess.CompletedProcess[str]:
    """Run code, or a module, with ``home`` for the hub's client; offline, or with a ``hub`` at that URL."""
    environment = {**os.environ, "HF_HOME": str(home)}
    environment |= {"HF_HUB_OFFLINE": "1"} if hub is None else {"HF_HUB_OFFLINE": "0", "HF_ENDPOINT": hub}
    command = [sys.executable, *(["-c", code] if code else []), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment, check=False)


def test_auto_classes_load_the_whole_network(tmp_path: Path) -> None:
    done = run(LOADED_BY_NAME, CHECKPOINT, tmp_path / "out", home=tmp_path)
    assert done.returncode == 0, done.stderr
    ours = load(CHECKPOINT)
    inputs = LookTwiceProcessor(ours.vocabulary.tokenizer, ours.settings.to_dict())(
        next(read_scenes(SCENES)).scene
    )
    with torch.no_grad():
        logits = ours.model(**inputs).logits.numpy()
    theirs = load_file(tmp_path / "out")["logits"]
    assert logits.shape == theirs.shape
    np.testing.assert_allclose(theirs, logits, atol=1e-4)


def test_the_snippet_of_the_card_runs_with_its_folder(tmp_path: Path) -> None:
    (snippet,) = re.findall(r"^```python\n(.*?)^```", (CHECKPOINT / "README.md").read_text(), re.S | re.M)
    done = run(f"FOLDER = {str(CHECKPOINT)!r}\n{snippet}", home=tmp_path)
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(r"torch\.Size\(\[1, [0-9]+, [0-9]+\]\)\n", done.stdout)


@pytest.mark.parametrize("name", CHECKPOINTS)
def test_the_bundled_folders_are_what_is_written_today(tmp_path: Path, name: str) -> None:
    bundled = CHECKPOINTS[name]
    folder = Path(shutil.copytree(bundled, tmp_path / name))
    write_repository(folder)
    for file in folder.iterdir():
        assert file.read_bytes() == (bundled / file.name).read_bytes(), f"{file.name}: looktwice describe"


@pytest.mark.parametrize("scene_tokens", [0, 16])
def test_the_chat_template_writes_our_prompts(tmp_path: Path, scene_tokens: int) -> None:
    settings = VlaSettings(with_tracks=True, scene_tokens=scene_tokens)
    tokenizer = read_parts(CHECKPOINT).vocabulary.tokenizer
    for task, route, tracks in product(("cf_vla", "traj_only"), (False, True), (False, True)):
        kinds = ["video", "history", *["route"] * route, *["tracks"] * tracks]
        content = [{"type": "text", "text": family_named(task).task}, *({"type": kind} for kind in kinds)]
        written = tokenizer.apply_chat_template(
            [{"role": "user", "content": content}],
            chat_template=chat_template(settings),
            add_generation_prompt=True,
            tokenize=False,
        )
        assert written == "".join(prompt_text(task, settings, route=route, tracks=tracks))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint as it is written; not to be changed."""
    return write_untrained(tmp_path_factory.mktemp("written") / "new", narrow=True)


@pytest.fixture
def folder(written: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(written, tmp_path / "new"))


def test_a_new_checkpoint_has_a_card_that_tells_what_it_is(written: Path) -> None:
    card = (written / "README.md").read_text()
    assert read_card(written)["revision"] in card
    assert "Not for road use" in card
    assert "No training is recorded" in card
    assert "None are recorded" in card


def test_describe_keeps_weights_and_records_figures(folder: Path) -> None:
    weights = (folder / "model.safetensors").read_bytes()
    told = ["describe", str(folder), "--figure", "minADE of 6 = 2.35 m", "--figure", "a=b=3"]
    result = CliRunner().invoke(app, told)
    assert result.exit_code == 0, result.output
    card = (folder / "README.md").read_text()
    assert "| minADE of 6 | 2.35 m |\n| a=b | 3 |" in card
    write_repository(folder)
    assert (folder / "README.md").read_text() == card, "figures are kept"
    assert (folder / "model.safetensors").read_bytes() == weights


def test_describe_names_a_checkpoint_and_what_it_is_for(folder: Path) -> None:
    weights, before = (folder / "model.safetensors").read_bytes(), read_parts(folder)
    assert before.settings.formats == ("cf_vla", "traj_only")
    refused = CliRunner().invoke(app, ["describe", str(folder), "--name", "b", "--format", "elf_vla"])
    assert refused.exit_code == 2
    assert "does not write elf_vla: it writes cf_vla, traj_only" in " ".join(refused.output.split())
    assert read_parts(folder).card == before.card
    told = ["describe", str(folder), "--name", "quick", "--format", "traj_only"]
    assert CliRunner().invoke(app, told).exit_code == 0
    after = read_parts(folder)
    assert (after.card.name, after.settings.name) == ("quick", "quick")
    assert after.card.formats == after.settings.formats == ("traj_only",)
    assert (folder / "model.safetensors").read_bytes() == weights
    card = (folder / "README.md").read_text()
    assert "# quick\n\nA model that gives 6.4 s of trajectory at once. " in card
    assert f"| trajectory | 64 poses up to 6.4 s, 6 codes of {after.codec.size} |" in card


@pytest.mark.parametrize("figure", ["none", "a=", "=3", "a|b=3"])
def test_describe_refuses_what_is_no_figure(folder: Path, figure: str) -> None:
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    result = CliRunner().invoke(app, ["describe", str(folder), "--figure", figure])
    assert result.exit_code == 2
    assert "WHAT=VALUE" in result.output
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before


def test_a_stock_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no looktwice\.json"):
        write_repository(tmp_path)


PLAN = ("-m", "looktwice.service.cli", "plan", "--n", 1, "--json")


def test_a_name_on_the_hub_is_a_checkpoint(tmp_path: Path) -> None:
    """As the hub's own client keeps what it downloaded."""
    kept = tmp_path / "hub" / "models--somebody--nano"
    revision = "0123456789abcdef0123456789abcdef01234567"
    shutil.copytree(CHECKPOINT, kept / "snapshots" / revision)
    (kept / "refs").mkdir()
    (kept / "refs" / "main").write_text(revision)
    out = ("--out", tmp_path / "out")
    done = run("", *PLAN, *out, "--checkpoint", "somebody/nano", home=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["draws"]
    other = run("", *PLAN, *out, "--checkpoint", "somebody/nano@v2", home=tmp_path)
    assert other.returncode == 2


COMMIT = "89abcdef0123456789abcdef0123456789abcdef"


def hub_of(name: str, folder: Path, asked: list[str]) -> Starlette:
    """A hub with one model repository; it notes which files are downloaded of it.

    It answers as the hub's documented API does: https://huggingface.co/docs/hub/api.
    """
    files = {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
    digests = {path: hashlib.sha1(file.read_bytes()).hexdigest() for path, file in files.items()}

    async def info(request: Request) -> Response:
        siblings = [{"rfilename": path} for path in files]
        return JSONResponse({"id": name, "modelId": name, "sha": COMMIT, "siblings": siblings})

    async def tree(request: Request) -> Response:
        assert request.path_params["revision"] == COMMIT
        return JSONResponse(
            [
                {"type": "file", "path": path, "size": file.stat().st_size, "oid": digests[path]}
                for path, file in files.items()
            ]
        )

    async def content(request: Request) -> Response:
        path = request.path_params["path"]
        if request.method == "GET":
            asked.append(path)
        headers = {"X-Repo-Commit": COMMIT, "ETag": f'"{digests[path]}"'}
        return Response(files[path].read_bytes(), headers=headers, media_type="application/octet-stream")

    return Starlette(
        routes=[
            Route(f"/api/models/{name}/revision/main", info),
            Route(f"/api/models/{name}/tree/{{revision}}", tree),
            Route(f"/{name}/resolve/{COMMIT}/{{path:path}}", content, methods=["GET", "HEAD"]),
        ]
    )


def test_a_checkpoint_is_downloaded_from_the_hub_without_what_it_does_not_need(
    folder: Path, tmp_path: Path
) -> None:
    write_repository(folder)
    for unneeded in ("pytorch_model.bin", "weights.pkl", "log.jsonl", "extra/setup.py"):
        (folder / unneeded).parent.mkdir(exist_ok=True)
        (folder / unneeded).write_bytes(b"not needed")
    told = (*PLAN, "--out", tmp_path / "out", "--checkpoint", "somebody/nano")
    asked: list[str] = []
    with listening(hub_of("somebody/nano", folder, asked)) as (url, _):
        done = run("", *told, home=tmp_path, hub=url)
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["draws"]
        assert {"model.safetensors", "looktwice.json", "tokenizer.json", "README.md"} <= set(asked)
        assert {Path(path).suffix for path in asked} == {".json", ".safetensors", ".jinja", ".md"}
        assert len(asked) == len(set(asked))
        asked.clear()
        missing = run("", *told[:-1], "somebody/other", home=tmp_path, hub=url)
        assert missing.returncode == 2
        assert "no such model on the Hugging Face hub" in missing.stderr
        assert missing.stderr.count("\n") == 1
    again = run("", *told, home=tmp_path)  # what was downloaded is kept
    assert json.loads(again.stdout)["draws"] == json.loads(done.stdout)["draws"]


def test_without_the_hub_it_says_so_in_a_line(tmp_path: Path) -> None:
    done = run("", *PLAN, "--checkpoint", "somebody/nano", home=tmp_path)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "no folder somebody/nano" in line
    assert "cannot be reached" in line
    folder = run("", *PLAN, "--checkpoint", tmp_path / "nowhere", home=tmp_path)
    assert folder.returncode == 2
    assert "is not a LookTwice checkpoint" in folder.stderr
