"""What is installed: one name, `looktwice`, and every module and file that it needs."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import pytest

from looktwice.model.bundled import CHECKPOINTS
from tests.docs.clean_clone import copy_clone
from tests.test_architecture import PACKAGES, ROOT

DATA = (
    *("py.typed", "model/bundled/scenes.parquet", "model/bundled/looktwice-nano/model.safetensors"),
    *("model/bundled/looktwice-nano/README.md", "model/bundled/elf-nano/model.safetensors"),
    "model/bundled/world-nano/visual_codes.safetensors",
    *("service/inspector/index.html", "loadtests/page.html"),
)


def built(source: Path, what: str) -> Path:
    """What the build backend makes of a source folder: ``wheel`` or ``sdist``."""
    out = source.parent / what
    code = f"import sys; from setuptools import build_meta; build_meta.build_{what}(sys.argv[1])"
    subprocess.run([sys.executable, "-c", code, out], cwd=source, capture_output=True, check=True)
    (made,) = out.iterdir()
    return made


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clone") / "looktwice"
    copy_clone(folder)
    return folder


@pytest.fixture(scope="module")
def wheel(clone: Path) -> Path:
    return built(clone, "wheel")


@pytest.fixture(scope="module")
def installed(wheel: Path) -> Path:
    """A folder with the wheel's files, as pip leaves them."""
    folder = wheel.parent / "installed"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def contents(wheel: Path) -> set[PurePosixPath]:
    """Its files, what describes it left out."""
    with zipfile.ZipFile(wheel) as archive:
        names = [PurePosixPath(name) for name in archive.namelist()]
    return {name for name in names if not name.parts[0].endswith(".dist-info")}


def modules() -> Iterator[PurePosixPath]:
    """Where a wheel should have what can be imported here."""
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            if all(
                (folder / "__init__.py").exists()
                for folder in path.parents
                if ROOT / package in (folder, *folder.parents)
            ):
                yield PurePosixPath("looktwice", path.relative_to(ROOT).as_posix())


def test_there_is_one_name_and_all_modules_and_files(wheel: Path) -> None:
    found = contents(wheel)
    assert {name.parts[0] for name in found} == {"looktwice"}
    code = {name for name in found if name.suffix == ".py" and not CHECKPOINTS.keys() & {*name.parts}}
    assert code == {*modules(), PurePosixPath("looktwice/__init__.py")}
    assert {PurePosixPath("looktwice", name) for name in DATA} <= found


def test_check_wheel_contents_finds_nothing(wheel: Path) -> None:
    command = [sys.executable, "-m", "check_wheel_contents", str(wheel)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stdout


def test_a_source_distribution_builds_the_same_wheel(clone: Path, wheel: Path) -> None:
    source = built(clone, "sdist")
    with tarfile.open(source) as archive:
        archive.extractall(source.parent / "source", filter="data")
    (unpacked,) = (source.parent / "source").iterdir()
    assert contents(built(unpacked, "wheel")) == contents(wheel)


def test_modules_of_ones_own_with_the_same_names_do_no_harm(installed: Path, tmp_path: Path) -> None:
    for package in PACKAGES:
        (tmp_path / f"{package}.py").write_text("MINE = True\n")
    script = tmp_path / "script.py"
    names = ", ".join(PACKAGES)
    script.write_text(
        f"import {names}\n"
        "from looktwice.clients import PlannerClient\n"
        "from looktwice.model.bundled import CHECKPOINT, SCENES\n"
        "from looktwice.service.app import create_app\n"
        f"assert all(each.MINE for each in ({names}))\n"
        "print(CHECKPOINT, SCENES.is_file())\n"
    )
    environment = os.environ | {"PYTHONPATH": str(installed)}
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, cwd=tmp_path, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [str(installed / "looktwice/model/bundled/looktwice-nano"), "True"]
