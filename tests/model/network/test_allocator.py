"""Freed memory stays with a process that asked for it, and goes back where that was asked."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

_PROBE = """
import resource, sys
import torch
from looktwice.model.network.allocator import keep_freed_memory
if sys.argv[1] == "kept":
    assert keep_freed_memory()
for _ in range(30):  # until small blocks have found their places between the large ones
    torch.ones(16_000_000)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    torch.ones(16_000_000)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


_HOLES = """
import os
from looktwice.model.network.allocator import FreedMemory
blocks = [bytearray(100_000) for _ in range(2000)]
del blocks[:-1:2], blocks[:-1:2]  # all but one of four, so that holes are left
resident = lambda: int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
now_s = 0.0
freed = FreedMemory(lambda: now_s)
before = resident()
assert not freed.give_back()
assert abs(resident() - before) < 10_000_000
now_s = 60.0
assert freed.give_back()
assert not freed.give_back()
print(before - resident())
"""
_BODIES = """
import os, sys
from looktwice.model.network.allocator import return_large_buffers
if sys.argv[1] == "returned":
    assert return_large_buffers()
resident = lambda: int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
bytearray(31_000_000)  # from which glibc learns to keep buffers of this size
before = resident()
bodies = [bytearray(b"x") * 20_000_000 for _ in range(10)]
last = bytearray(100_000)
del bodies
print(resident() - before)
"""
only_glibc = pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="other allocators are left as they are"
)


@only_glibc
def test_what_is_free_between_what_is_used_goes_back_now_and_then() -> None:
    assert int(_printed(_HOLES)) > 100_000_000


@only_glibc
def test_tensors_made_anew_cost_no_page_faults() -> None:
    """20 tensors of 64 MB: their pages are mapped once, not 20 times."""
    assert _page_faults("mapped") > 10 * _page_faults("kept")


@only_glibc
def test_what_large_buffers_took_goes_back_at_once() -> None:
    kept, returned = (int(_printed(_BODIES, mode)) for mode in ("kept", "returned"))
    assert kept > 100_000_000
    assert returned < 10_000_000


def _page_faults(mode: str) -> int:
    return int(_printed(_PROBE, mode))


def _printed(program: str, *arguments: str) -> str:
    ran = subprocess.run(
        [sys.executable, "-c", program, *arguments], check=True, capture_output=True, text=True, timeout=120
    )
    return ran.stdout
