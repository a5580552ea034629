from __future__ import annotations

from collections.abc import Iterator

import pytest

from model.families.registry import GROUP, family_named


@pytest.fixture(scope="module")
def toy_family(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The family `toy` is there, as an installed package declares it."""
    installed = tmp_path_factory.mktemp("installed")
    about = installed / "toy-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: toy\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[{GROUP}]\ntoy = tests.families.toy:TOY\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(installed)
        yield
    family_named.cache_clear()
