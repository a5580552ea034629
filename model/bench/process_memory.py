"""Memory of a process and all that it started, on Linux."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

_PROC: Final = Path("/proc")
_FORGET_THE_PEAK: Final = "5"
"""See proc_pid_clear_refs(5)."""


def peak_bytes(pid: int | None = None) -> int:
    """The peaks of resident memory of a process (this one by default) and its descendants, added up.

    Pages that they share count once for each.
    """
    return sum(_peak_of(each) for each in _family(pid))


def forget_peaks(pid: int | None = None) -> None:
    """Let `peak_bytes` tell of what comes from now on; where the kernel does not, all of it as before."""
    for each in _family(pid):
        with suppress(OSError):  # ended meanwhile
            (_PROC / str(each) / "clear_refs").write_text(_FORGET_THE_PEAK)


def _family(pid: int | None) -> Iterator[int]:
    """A process and its descendants."""
    children: dict[int, list[int]] = {}
    for folder in _PROC.glob("[0-9]*"):
        try:
            # The command's name stands in brackets and may hold anything; the parent comes two behind it.
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
        except (OSError, ValueError, IndexError):
            continue  # ended meanwhile
        children.setdefault(parent, []).append(int(folder.name))
    open_ids = [pid or os.getpid()]
    while open_ids:
        each = open_ids.pop()
        yield each
        open_ids += children.get(each, [])


def _peak_of(pid: int) -> int:
    try:
        for line in (_PROC / str(pid) / "status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass  # ended meanwhile
    return 0
