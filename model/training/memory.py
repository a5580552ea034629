"""What the C library's allocator does with the memory that a training step frees."""

from __future__ import annotations

import ctypes
import platform
from typing import Final

_GLIBC_TRIM_THRESHOLD: Final = -1
_GLIBC_MMAP_MAX: Final = -4
_GLIBC_ARENA_MAX: Final = -8


def keep_freed_memory() -> bool:
    """Let glibc keep what is freed for the next step, for the rest of this process.

    By default glibc maps every large tensor anew and unmaps it when it is freed; a CPU then spends more time
    on clearing pages than on learning. The price is that memory stays at its peak.

    Returns:
        Whether it was done: other C libraries are left as they are.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    libc = ctypes.CDLL(None)
    # One arena: those of other threads are made of small maps and would fall back to mapping large tensors.
    options = ((_GLIBC_MMAP_MAX, 0), (_GLIBC_TRIM_THRESHOLD, -1), (_GLIBC_ARENA_MAX, 1))
    return all(libc.mallopt(option, value) == 1 for option, value in options)
