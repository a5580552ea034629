"""What the C library's allocator does with the memory that a process frees."""

from __future__ import annotations

import ctypes
import platform
import time
from collections.abc import Callable
from functools import cache
from typing import Final

_GLIBC_TRIM_THRESHOLD: Final = -1
_GLIBC_MMAP_THRESHOLD: Final = -3
_GLIBC_MMAP_MAX: Final = -4
_GLIBC_ARENA_MAX: Final = -8
_EVERY_S: Final = 30.0
_LARGE_BYTES: Final = 4_000_000
"""More than a request's usual body, pictures and tensors have."""
_KEPT_BYTES: Final = 64_000_000
"""At the end of the memory: as many as glibc would keep by itself in the end."""


def keep_freed_memory() -> bool:
    """Let glibc keep what is freed for the next training step, for the rest of this process.

    By default glibc maps every large tensor anew and unmaps it when it is freed; a CPU then spends more time
    on clearing pages than on learning. The price is that memory stays at its peak.

    Returns:
        Whether it was done: other C libraries are left as they are.
    """
    libc = _glibc()
    if libc is None:
        return False
    # One arena: those of other threads are made of small maps and would fall back to mapping large tensors.
    options = ((_GLIBC_MMAP_MAX, 0), (_GLIBC_TRIM_THRESHOLD, -1), (_GLIBC_ARENA_MAX, 1))
    return all(libc.mallopt(option, value) == 1 for option, value in options)


def return_large_buffers() -> bool:
    """Let glibc give the memory of every large buffer back when it is freed, for the rest of this process.

    By default it learns to keep buffers of up to 32 MB: of large bodies and pictures a third of a gigabyte
    would stay with the threads that read them.

    Returns:
        Whether it was done: other C libraries are left as they are.
    """
    libc = _glibc()
    if libc is None:
        return False
    options = ((_GLIBC_MMAP_THRESHOLD, _LARGE_BYTES), (_GLIBC_TRIM_THRESHOLD, _KEPT_BYTES))
    return all(libc.mallopt(option, value) == 1 for option, value in options)


class FreedMemory:
    """Gives the system back, now and then, what was freed between blocks that are still used.

    glibc gives back what is free at the end of a thread's memory and keeps all holes. Tensors of many sizes,
    some of which are kept for the next request, leave more and more of them: by a sixth of a service's
    memory within half an hour. It takes some 10 ms, hence seldom.

    Args:
        clock: seconds, ever growing.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._at_s = clock, clock()

    def give_back(self) -> bool:
        """Whether it did: not where it was a short while ago; other C libraries are left as they are."""
        libc, now_s = _glibc(), self._clock()
        if libc is None or now_s - self._at_s < _EVERY_S:
            return False
        self._at_s = now_s
        libc.malloc_trim(0)
        return True


@cache
def _glibc() -> ctypes.CDLL | None:
    return ctypes.CDLL(None) if platform.libc_ver()[0] == "glibc" else None
