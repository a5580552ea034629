"""Results in a file that a kill may have cut."""

from __future__ import annotations

from pathlib import Path

import pytest

from looktwice.clients.metadrive.result_store import ResultStore


def store(file: Path) -> ResultStore[int]:
    return ResultStore(file, "drive", int, int)


def test_what_is_whole_is_found_again_behind_a_kill(tmp_path: Path) -> None:
    file = tmp_path / "drives.jsonl"
    first = store(file)
    first.store("a", 1)
    first.store("b", 2)
    whole = file.read_text()
    for cut in range(1, len(whole)):
        file.write_text(whole[:cut])
        again = store(file)
        lines = whole[:cut].count("\n")
        assert (again.find("a"), again.find("b")) == (1 if lines else None, None)
        again.store("c", 3)
        assert store(file).find("c") == 3


@pytest.mark.parametrize(
    "content",
    ['{"scene": {}}', '{"scene": {}}\n', "[1]\n", "no json\n", '{"key": "a"}\n', "a line\nand more"],
)
def test_another_file_is_refused_and_stays_as_it_is(tmp_path: Path, content: str) -> None:
    file = tmp_path / "plan.json"
    file.write_text(content)
    with pytest.raises(ValueError, match=r"plan\.json"):
        store(file)
    assert file.read_text() == content
