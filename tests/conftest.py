from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import settings

# Small tensors: a second thread gains nothing, and where another process has the core it costs tenfold.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# A process that a test starts need not compile our modules again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# How long an example takes says how busy the machine is, not whether the code is right.
settings.register_profile("no time limit", deadline=None)
settings.load_profile("no time limit")


@pytest.fixture(scope="session")
def untrained_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint folder with random weights; shared, so do not write into it."""
    from tests.checkpoints import write_untrained

    return write_untrained(tmp_path_factory.mktemp("checkpoint") / "untrained")


@pytest.fixture(scope="session")
def brief_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As `resampling_checkpoint`, but narrow, for tests of many responses.

    Its reflections are phrases: with the free text of `untrained_checkpoint` a response takes eight times as
    long.
    """
    from looktwice.model.network.vla_settings import NANO_SETTINGS
    from tests.checkpoints import write_untrained

    folder = tmp_path_factory.mktemp("checkpoint") / "brief"
    return write_untrained(folder, narrow=True, settings=NANO_SETTINGS)


@pytest.fixture(scope="session")
def resampling_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As `untrained_checkpoint`, but with a resampler and tracks, as the shipped model's recipe makes it."""
    from looktwice.model.network.vla_settings import NANO_SETTINGS
    from tests.checkpoints import write_untrained

    folder = tmp_path_factory.mktemp("checkpoint") / "resampling"
    return write_untrained(folder, settings=NANO_SETTINGS)


@pytest.fixture(scope="session")
def refining_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Untrained, thinks and refines: its only formats are those of ELF-VLA."""
    from dataclasses import replace

    from looktwice.model.network.vla_settings import NANO_SETTINGS
    from tests.checkpoints import write_untrained

    folder = tmp_path_factory.mktemp("checkpoint") / "refining"
    return write_untrained(folder, settings=replace(NANO_SETTINGS, formats=("elf_vla", "elf_vla_refine")))


@pytest.fixture(scope="module")
def toy_family(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The family `toy` is there, as an installed package declares it."""
    with _installed(tmp_path_factory.mktemp("installed"), "toy", "tests.families.toy:TOY"):
        yield


@pytest.fixture(scope="module")
def spoken_family(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The family `spoken` is there, likewise."""
    with _installed(tmp_path_factory.mktemp("installed"), "spoken", "tests.families.spoken:SPOKEN"):
        yield


@contextmanager
def _installed(folder: Path, name: str, value: str) -> Iterator[None]:
    from looktwice.model.families.registry import GROUP, family_named

    about = folder / f"{name}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[{GROUP}]\n{name} = {value}\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        yield
    family_named.cache_clear()
