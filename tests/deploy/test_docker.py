"""Images: that hadolint finds nothing, that pins agree, and that the build finds what it copies."""

from __future__ import annotations

import re
import subprocess
import tomllib
from pathlib import Path, PurePosixPath

import pytest
from packaging.requirements import Requirement

from looktwice.service.operations.settings import Settings
from tests.deploy.tools import DEPLOY, ROOT, run

DOCKERFILES = sorted((DEPLOY / "docker").glob("*.Dockerfile"))
CONSTRAINTS = {
    "cpu": ROOT / "constraints.txt",
    "cuda": DEPLOY / "docker" / "cuda.constraints.txt",
}


@pytest.fixture(scope="module")
def context() -> set[str]:
    """What a build is sent: the tracked files, less what .dockerignore leaves out."""
    lines = (ROOT / ".dockerignore").read_text().splitlines()
    patterns = [line for line in lines if line and not line.startswith("#")]
    return {file for file in tracked() if not ignored(file, patterns)}


def tracked() -> list[str]:
    told = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    return told.stdout.splitlines()


def ignored(file: str, patterns: list[str]) -> bool:
    """As Docker decides: the last pattern decides that matches the file or a folder that it is in."""
    path = PurePosixPath(file)
    left_out = False
    for pattern in patterns:
        # From the context's root on, which match() takes the leading slash for.
        if any(PurePosixPath("/", one).match("/" + pattern.lstrip("!")) for one in (path, *path.parents)):
            left_out = not pattern.startswith("!")
    return left_out


def pins(constraints: Path) -> dict[str, str]:
    pairs = (line.split("==") for line in constraints.read_text().splitlines())
    return {name.lower().replace("_", "-"): version for name, version in pairs}


@pytest.mark.parametrize("dockerfile", DOCKERFILES, ids=lambda path: str(path.stem))
def test_hadolint_finds_nothing(dockerfile: Path) -> None:
    assert run("hadolint", "--failure-threshold", "style", dockerfile) == ""


@pytest.mark.parametrize("dockerfile", DOCKERFILES, ids=lambda path: str(path.stem))
def test_an_image_runs_as_nobody_stops_on_sigterm_and_tells_its_health(dockerfile: Path) -> None:
    text = dockerfile.read_text()
    last = text[text.rindex("\nFROM ") :]
    assert re.search(r"^USER [1-9]\d*:[1-9]\d*$", last, re.MULTILINE)
    assert "STOPSIGNAL SIGTERM" in last
    assert "HEALTHCHECK" in last
    assert "/healthz" in last
    # Exec form: the service itself gets the signal.
    assert re.search(r'^ENTRYPOINT \["looktwice"\]$', last, re.MULTILINE)


def test_images_have_the_same_base_by_its_exact_version() -> None:
    bases = {re.search(r"^ARG PYTHON=(.*)$", file.read_text(), re.MULTILINE) for file in DOCKERFILES}
    found = {match[1] for match in bases if match}
    assert len(found) == 1
    assert re.fullmatch(r"3\.11\.\d+-slim-\w+", found.pop())


@pytest.mark.parametrize("image", CONSTRAINTS)
def test_an_image_pins_what_the_constraints_pin(image: str) -> None:
    pinned = pins(CONSTRAINTS[image])
    text = (DEPLOY / "docker" / f"{image}.Dockerfile").read_text()
    assert CONSTRAINTS[image].name in text
    for name, version in re.findall(r"\b(torch|vllm)==([\w.]+)", text):
        assert pinned[name] == version


@pytest.mark.parametrize("dockerfile", DOCKERFILES, ids=lambda path: str(path.stem))
def test_an_image_has_ray_only_where_its_label_says_so(dockerfile: Path) -> None:
    """Ray Serve brings HAProxy, which is under the GPL."""
    build, last = dockerfile.read_text().rsplit("\nFROM ", 1)
    assert re.findall(r"\[([a-z,]+)(.*?)\]\"", build) == [
        ("otel,serve" if dockerfile.stem == "cpu" else "otel,serve,vllm", "${RAY:+,ray}")
    ]
    assert 'image.licenses="Apache-2.0${RAY:+ AND GPL-2.0-or-later}"' in last
    assert build.count('ARG RAY=""') == last.count('ARG RAY=""') == 1


def test_the_constraints_for_gpus_admit_what_the_package_asks_for() -> None:
    pinned = pins(CONSTRAINTS["cuda"])
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    asked = [Requirement(line) for extra in ("serve", "vllm", "ray") for line in extras[extra]]
    for requirement in asked:
        if requirement.name != "looktwice":
            assert requirement.specifier.contains(pinned[requirement.name]), requirement


def test_a_build_is_sent_what_it_installs_and_nothing_else(context: set[str]) -> None:
    packages = ("clients/", "loadtests/", "model/", "service/", "src/")
    assert {file for file in tracked() if file.startswith(packages)} <= context
    assert {"deploy/ray/app.py", "pyproject.toml", "constraints.txt", "README.md", "NOTICE"} <= context
    assert not {file for file in context if file.startswith(("tests/", "docs/", "deploy/helm/", ".git"))}


def test_the_service_keeps_its_own_settings_out_of_the_image() -> None:
    """Who may ask, and for how long it drains, is decided where it runs."""
    prefix = Settings.model_config["env_prefix"]
    for dockerfile in DOCKERFILES:
        told = [line for line in dockerfile.read_text().splitlines() if not line.startswith("#")]
        assert prefix not in "\n".join(told)
