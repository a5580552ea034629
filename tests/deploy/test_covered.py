from __future__ import annotations

from tests.deploy.covered import checks


def test_every_file_is_checked_by_something() -> None:
    found = dict(checks())
    assert len(found) > 30
    assert [file for file, check in found.items() if check is None] == []
