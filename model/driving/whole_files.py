"""Files that are whole or not there, whatever ends the process that writes them."""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def written_whole(path: Path) -> Generator[Path]:
    """A place to write to, which becomes ``path`` when the block ends well, and goes when it does not.

    What a process that was killed left of an earlier try is taken away. The folder is made. Who may read the
    file is up to the umask, whatever wrote it: safetensors writes files that nobody but their owner can read.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    for left in path.parent.glob(f".{path.name}.*.tmp"):
        if _has_ended(left.name.split(".")[-2]):
            left.unlink(missing_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.touch()
        mode = temporary.stat().st_mode
        yield temporary
        temporary.chmod(mode)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _has_ended(pid: str) -> bool:
    if not pid.isdigit():
        return False
    try:
        os.kill(int(pid), 0)
    except OSError as error:  # otherwise it runs, for somebody else
        return isinstance(error, ProcessLookupError)
    return False
