"""Memory of a process and all that it started, on Linux."""

from __future__ import annotations

import os
from pathlib import Path

_PROC = Path("/proc")


def peak_bytes(pid: int | None = None) -> int:
    """The peaks of resident memory of a process (this one by default) and its descendants, added up.

    Pages that they share count once for each.
    """
    children: dict[int, list[int]] = {}
    for folder in _PROC.glob("[0-9]*"):
        try:
            # The command's name stands in brackets and may hold anything; the parent comes two behind it.
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
        except (OSError, ValueError, IndexError):
            continue  # ended meanwhile
        children.setdefault(parent, []).append(int(folder.name))
    total, open_ids = 0, [pid or os.getpid()]
    while open_ids:
        each = open_ids.pop()
        total += _peak_of(each)
        open_ids += children.get(each, [])
    return total


def _peak_of(pid: int) -> int:
    try:
        for line in (_PROC / str(pid) / "status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass  # ended meanwhile
    return 0
