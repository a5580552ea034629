from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from looktwice.model.driving.whole_files import written_whole


def test_a_file_is_whole_or_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "made" / "file"
    with written_whole(path) as temporary:
        temporary.write_text("first")
        assert not path.exists()
    assert path.read_text() == "first"
    with pytest.raises(RuntimeError):
        _fail_halfway(path)
    assert path.read_text() == "first"
    assert list(path.parent.iterdir()) == [path]


def test_who_may_read_it_is_up_to_the_umask(tmp_path: Path) -> None:
    plain, path = tmp_path / "plain", tmp_path / "file"
    plain.touch()
    with written_whole(path) as temporary:
        temporary.unlink()
        temporary.touch(mode=0o600)
    assert path.stat().st_mode == plain.stat().st_mode


def _fail_halfway(path: Path) -> None:
    with written_whole(path) as temporary:
        temporary.write_text("half of the sec")
        raise RuntimeError


def test_what_a_killed_process_left_goes_and_what_another_writes_stays(tmp_path: Path) -> None:
    path = tmp_path / "file"
    killed = (
        "import os, sys; from pathlib import Path\n"
        "from looktwice.model.driving.whole_files import written_whole\n"
        "with written_whole(Path(sys.argv[1])) as temporary:\n"
        "    temporary.write_text('half'); os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", killed, str(path)], check=False)
    assert len(list(tmp_path.iterdir())) == 1, "a process that is killed cannot tidy up"
    others = [tmp_path / f".file.{os.getppid()}.tmp", tmp_path / ".file.notes.tmp"]
    for other in others:
        other.write_text("somebody else's")
    with written_whole(path) as temporary:
        temporary.write_text("whole")
    assert sorted(tmp_path.iterdir()) == sorted([path, *others])
