from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.metadata import distribution
from pathlib import Path

import pytest

from looktwice.model.families.cf_vla import CF_VLA
from looktwice.model.families.cf_vla.format import PHRASES
from looktwice.model.families.cf_vla.traj_only import TRAJ_ONLY
from looktwice.model.families.family import FamilyError
from looktwice.model.families.registry import GROUP, families_of, family_named

MODULE = """
from looktwice.model.families.family import Family, Reading
from looktwice.model.formats.pieces import Format, Literal, Section

POEM = Family(
    Format("poem", Section("verse", Literal("Roses are red"))),
    "Write a poem.",
    trajectory="verse",
    read=lambda values, decode: Reading(decode([0] * 6)),
)
"""


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], None]]:
    """Install a package that declares families, by the lines of its entry points."""
    family_named.cache_clear()

    def install(*lines: str) -> None:
        (tmp_path / "verses.py").write_text(MODULE)
        about = tmp_path / "verses-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text("Metadata-Version: 2.1\nName: verses\nVersion: 1.0\n")
        (about / "entry_points.txt").write_text("\n".join([f"[{GROUP}]", *lines]))
        monkeypatch.syspath_prepend(tmp_path)
        assert distribution("verses").version == "1.0"

    yield install
    family_named.cache_clear()


def test_ours_are_there_in_both_dialects() -> None:
    plain, phrased = (families_of(("cf_vla", "traj_only"), each) for each in ("free_text", "phrases"))
    assert plain["cf_vla"].format is CF_VLA.format
    assert phrased["cf_vla"].format is PHRASES
    assert plain["traj_only"].format is phrased["traj_only"].format is TRAJ_ONLY.format


def test_an_installed_package_declares_its_own(install: Callable[[str], None]) -> None:
    install("poem = verses:POEM")
    poem = family_named("poem")
    assert (poem.name, poem.task) == ("poem", "Write a poem.")
    assert families_of(["poem"], "phrases")["poem"].format is poem.format


@pytest.mark.parametrize(
    ("line", "name", "message"),
    [
        (
            "poem = verses:POEM",
            "novel",
            "no model family 'novel'; known are cf_vla, elf_vla, elf_vla_refine, poem, traj_only, vla_world",
        ),
        ("cf_vla = verses:POEM", "cf_vla", "'cf_vla' is declared more than once: .*verses:POEM"),
        ("ode = verses:POEM", "ode", "no family of that name"),
        ("ode = verses:ODE", "ode", "cannot be loaded: .*ODE"),
        ("ode = no_verses:ODE", "ode", "cannot be loaded: No module named 'no_verses'"),
    ],
)
def test_what_cannot_be_had_is_told(
    install: Callable[[str], None], line: str, name: str, message: str
) -> None:
    install(line)
    with pytest.raises(FamilyError, match=message):
        family_named(name)
