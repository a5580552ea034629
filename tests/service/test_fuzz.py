"""Schemathesis tries the whole described surface, with all its checks, over a real socket."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from looktwice.model.driving.scene import FRONT_WIDE
from looktwice.service.operations.keys import new_line
from looktwice.service.operations.settings import Settings
from tests.service.fuzz_hooks import IMAGINES, REFINES
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served, body, serve

CHECKS = (
    *("not_a_server_error", "status_code_conformance", "content_type_conformance"),
    *("response_schema_conformance", "response_headers_conformance"),
)
WITH_SCENES = (
    "^/v1/(plan|plan/batch|reflect|refine|imagine|label|score|score/batch|feedback|chat/completions)$"
)
CONFIG = """
# That a picture is one, and that a history can be driven, no schema can say: such bodies get a 422.
[checks]
positive_data_acceptance.expected-statuses = ["2xx", "401", "403", "404", "409", "422", "429"]
# Some wrong bodies are refused for their size, a member's name of over 200 characters among them.
negative_data_rejection.expected-statuses = ["400", "401", "404", "413", "415", "422", "429"]

# In OpenAI's dialect these are a 400.
[[operations]]
include-path = "/v1/chat/completions"
checks.positive_data_acceptance.expected-statuses = ["2xx", "400", "401", "403", "404", "409", "429"]

# A scene of a batch that breaks the contract gets its 422 within an answer to the others.
[[operations]]
include-path = "/v1/plan/batch"
checks.negative_data_rejection.expected-statuses = ["2xx", "400", "401", "404", "415", "422", "429"]

[[operations]]
include-path = "/v1/score/batch"
checks.negative_data_rejection.expected-statuses = ["2xx", "400", "401", "404", "415", "422", "429"]
"""


@pytest.fixture(scope="module")
def key_and_service(
    tmp_path_factory: pytest.TempPathFactory, scene_file: Path
) -> Iterator[tuple[str, Served]]:
    folder = tmp_path_factory.mktemp("fuzz")
    key, line = new_line("fuzzer")
    (folder / "keys").write_text(line)
    settings = Settings(bundled_scenes=scene_file, api_keys_file=folder / "keys", checkpoints=folder)
    engine = ScriptedEngine()
    engine.card_shown = replace(engine.card, formats=(*engine.card.formats, REFINES, IMAGINES), paints=True)
    with serve(engine, settings, headers={"Authorization": f"Bearer {key}"}) as served:
        yield key, served


@pytest.mark.parametrize(
    "options",
    [
        ("--exclude-path-regex", WITH_SCENES, "--max-examples", "20"),
        # Covering every bound of lists of lists of poses one by one takes hours: see fuzz_whole_scenes.py.
        (
            "--include-path-regex",
            WITH_SCENES,
            "--max-examples",
            "15",
            "--phases",
            "examples,fuzzing,stateful",
        ),
    ],
    ids=["without scenes", "with scenes"],
)
def test_nothing_described_can_break_the_service(
    key_and_service: tuple[str, Served], options: tuple[str, ...], tmp_path: Path
) -> None:
    key, served = key_and_service
    run(served, key, tmp_path, (*options, "--checks", "all"), "tests.service.fuzz_hooks", 300)


@pytest.mark.skipif("LOOKTWICE_TEST_COVERAGE" not in os.environ, reason="thousands of requests take a while")
def test_nothing_around_whole_scenes_can_break_the_service(tmp_path: Path, scene_file: Path) -> None:
    """Its coverage phase, in JSON, msgpack and multipart.

    The description is narrowed to scenes that can be planned for. So what is wrong by it may be right, and
    its checks that wrong data is refused and right data served say nothing here.
    """
    key, line = new_line("fuzzer")
    (tmp_path / "keys").write_text(line)
    engine = ScriptedEngine()
    engine.card_shown = replace(
        engine.card,
        cameras=(FRONT_WIDE,),
        inputs=("route", "tracks"),
        formats=(*engine.card.formats, REFINES, IMAGINES),
        paints=True,
    )
    settings = Settings(bundled_scenes=scene_file, api_keys_file=tmp_path / "keys")
    options = ("--include-path-regex", WITH_SCENES, "--phases", "coverage", "--checks", ",".join(CHECKS))
    with serve(engine, settings, headers={"Authorization": f"Bearer {key}"}) as served:
        run(served, key, tmp_path, options, "tests.service.fuzz_whole_scenes", 3000)
        assert served.metric("looktwice_labels_total", teacher="rules") > 0


def run(
    served: Served, key: str, folder: Path, options: tuple[str, ...], hooks: str, timeout_s: float
) -> None:
    """Run schemathesis; no check may fail, and no answer be the service's failure."""
    (folder / "schemathesis.toml").write_text(CONFIG)
    command = [
        str(Path(sys.executable).with_name("schemathesis")),
        *("run", f"{served.url}/openapi.json", "--header", f"Authorization: Bearer {key}", *options),
        *("--generation-deterministic", "--suppress-health-check", "all"),
        *("--request-timeout", "20", "--no-color"),
    ]
    environment = os.environ | {
        "SCHEMATHESIS_HOOKS": hooks,
        "PYTHONPATH": os.pathsep.join(sys.path),
        "PYTHONWARNINGS": "default",
    }
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=folder, env=environment, timeout=timeout_s
    )
    assert done.returncode == 0, re.sub(r"[A-Za-z0-9+/=]{200,}", "…", done.stdout)
    assert served.http.post("/v1/plan", json=body()).status_code == 200
    for status in ("500", "502", "503", "504"):
        assert served.metric("looktwice_requests_total", status=status) == 0
