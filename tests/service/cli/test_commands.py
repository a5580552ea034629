from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

import httpx
import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from looktwice.model.bundled import CHECKPOINT, SCENES
from looktwice.model.engines.torch.engine import TorchEngine
from looktwice.service.cli.commands import app
from looktwice.service.operations.settings import Settings, TeacherSettings
from tests.service.serving import body, serve

ROOT: Final = Path(__file__).parents[3]
PLAN: Final = """\
- longitudinal
  - 0.0s-6.4s: Keep Speed
- lateral
  - 0.0s-6.4s: Straight
- lane
  - 0.0s-6.4s: Keep Lane"""
ATTEMPT: Final = {"trajectory": [[1.2 * k, 0.0, 0.0, 0.0] for k in range(1, 65)], "feedback": "too fast"}


def ran(*arguments: str, code: int = 0) -> str:
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == code, result.output
    return result.output


def test_the_version_is_that_of_the_package() -> None:
    assert ran("--version").split() == ["looktwice", "0.1.0"]


@pytest.mark.parametrize("command", [(), ("serve",), ("build", "rollout"), ("scenes", "generate")])
def test_help_has_a_short_name(command: tuple[str, ...]) -> None:
    assert ran(*command, "-h") == ran(*command, "--help")


def test_every_setting_is_told_with_its_meaning() -> None:
    told = ran("serve", "--settings")
    for kind, prefix in ((Settings, "LOOKTWICE_"), (TeacherSettings, "LOOKTWICE_TEACHER_")):
        for name in kind.model_fields:
            assert f"\n{prefix}{name.upper()}=" in f"\n{told}", name
    lines = told.splitlines()
    assert all(line.startswith("    ") or lines[at + 1 :] for at, line in enumerate(lines))
    assert "sk-" not in told


def test_what_cannot_be_listened_on_is_refused() -> None:
    assert "65535" in ran("serve", "--port", "65536", code=2)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is one")
def test_a_port_that_is_taken_is_told_before_anything_is_loaded(tmp_path: Path) -> None:
    (tmp_path / "looktwice.json").write_text("{")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        told = ran("serve", "--port", str(port), "--checkpoint", str(tmp_path), code=2)
    assert told == f"looktwice: cannot listen at 127.0.0.1, port {port}: Address already in use\n"


def test_a_missing_gpu_is_told_in_a_line() -> None:
    told = ran("serve", "--device", "cuda", code=2)
    assert told.startswith("looktwice: there is no CUDA device")
    assert told.count("\n") == 1


def test_a_service_says_where_it_is_and_where_its_page_is() -> None:
    command = [sys.executable, "-m", "looktwice.service.cli", "serve", "--no-model", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as started:
        assert started.stdout is not None
        told = started.stdout.readline()
        url, page, description = re.findall(r"http://127\.0\.0\.1:[0-9]+[a-z/]*", told)
        assert (page, description) == (f"{url}/", f"{url}/docs")
        for place in (page, description):
            assert httpx.get(place, trust_env=False, timeout=60).status_code == 200
        started.terminate()
        assert started.wait(60) == 0


def test_a_load_test_says_what_its_rate_is() -> None:
    assert "on average" in " ".join(ran("loadtest", "--help").split())


def test_a_request_can_be_planned_for_without_a_service(tmp_path: Path) -> None:
    request = tmp_path / "request.json"
    request.write_text(json.dumps(body(n=3)))
    told = ran("plan", str(request), "--out", str(tmp_path))
    lines = told.splitlines()
    assert [line.split()[:2] for line in lines[1:4] if not line.startswith("*")] == [
        ["draw", str(k)] for k in range(3) if f"* draw {k} " not in told
    ]
    assert sum(line.startswith("* draw") for line in lines) == 1
    assert "Meta actions:\n- longitudinal" in told
    assert "<" not in told, "codes say nothing to people"
    assert list(tmp_path.glob("*.png"))


def test_a_request_is_planned_for_as_the_service_does(tmp_path: Path) -> None:
    document = body(n=3, seed=5, thinking="always", temperature=0.7, prefill=PLAN) | {"format": "cf_vla"}
    request = tmp_path / "request.json"
    request.write_text(json.dumps(document))
    told = json.loads(ran("plan", str(request), "--out", str(tmp_path), "--json"))
    with serve(TorchEngine(CHECKPOINT), Settings()) as served:
        answer = served.http.post("/v1/plan", json=document).raise_for_status().json()
    assert told["agreed"] == answer["agreed"]
    for here, there in zip(told["draws"], answer["draws"], strict=True):
        same = ("index", "branch", "think_probability", "tokens")
        assert {name: here[name] for name in same} == {name: there[name] for name in same}
        assert np.allclose(here["trajectory"], there["trajectory"], atol=0.001)
        for text in (there["plan"]["text"], there["thinking"], there["revised_plan"]["text"]):
            assert text in here["text"]


@pytest.mark.parametrize("said", [{"attempt": ATTEMPT}, {"format": "none-such"}])
def test_what_the_service_refuses_of_a_request_is_refused_here(tmp_path: Path, said: dict[str, Any]) -> None:
    (tmp_path / "request.json").write_text(json.dumps(body() | said))
    told = ran("plan", str(tmp_path / "request.json"), "--out", str(tmp_path), code=2)
    assert f"/{next(iter(said))}: " in told


@pytest.mark.parametrize("option", [("--n", "3"), ("--seed", "0"), ("--no-route",), ("--format", "cf_vla")])
def test_options_that_a_request_says_itself_are_refused(tmp_path: Path, option: tuple[str, ...]) -> None:
    (tmp_path / "request.json").write_text(json.dumps(body()))
    told = ran("plan", str(tmp_path / "request.json"), *option, code=2)
    assert told.endswith(f"leave out {option[0].replace('no-', '')}\n")


@pytest.mark.parametrize("content", ["{}", "nothing", '{"scene": {"scene_id": "a"}}'])
def test_what_is_no_request_is_told_in_a_line(tmp_path: Path, content: str) -> None:
    (tmp_path / "request.json").write_text(content)
    assert ran("plan", str(tmp_path / "request.json"), code=2).startswith("looktwice: ")


def test_half_a_second_ahead_is_fitted_and_measured(tmp_path: Path) -> None:
    told = ran("scenes", "short-term", str(SCENES), str(SCENES))
    figures = json.loads(ran("scenes", "short-term", str(SCENES), str(SCENES), "--json"))
    assert figures["scenes"] == 12
    assert f"{figures['ego_m']['fitted']:.3f} m" in told
    assert figures["ego_m"]["lambda_0"] < figures["ego_m"]["constant_velocity"]
    missing = str(tmp_path / "none.parquet")
    assert ran("scenes", "short-term", missing, missing, code=2) == f"looktwice: {missing} does not exist\n"


def test_help_needs_neither_torch_nor_the_service() -> None:
    code = (
        "import sys; from looktwice.service.cli.commands import app; "
        "print([name for name in ('torch', 'fastapi', 'numpy') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def ran_bare(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """A command where only `looktwice[serve]` is installed: neither the simulator nor other extras."""
    extras = ("accelerate", "cv2", "gltf", "hdrh", "metadrive", "panda3d", "psutil", "ray", "shapely")
    missing = f"import sys; sys.modules.update(dict.fromkeys({extras!r}))"
    code = f"{missing}; from looktwice.service.cli import main; main()"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(
        command, capture_output=True, text=True, cwd=folder, env=environment, check=False, timeout=300
    )


@pytest.mark.parametrize(
    "command",
    [
        ("scenes", "stats"),
        ("scenes", "show", "--limit", "1"),
        ("scenes", "pick", str(SCENES), "picked.parquet", "--count", "2"),
    ],
)
def test_scenes_are_counted_shown_and_picked_without_the_simulator(
    command: tuple[str, ...], tmp_path: Path
) -> None:
    done = ran_bare(*command, folder=tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "command",
    [("drive",), ("scenes", "generate", "out", "--first-seed", "0", "--episodes", "1"), ("loadtest",)],
)
def test_a_command_that_needs_more_says_what_to_install(command: tuple[str, ...], tmp_path: Path) -> None:
    done = ran_bare(*command, folder=tmp_path)
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert "`make sim`" in done.stderr
    assert "looktwice[load]" in done.stderr
