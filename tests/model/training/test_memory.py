"""Freed memory stays with a process that asked for it."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

_PROBE = """
import resource, sys
import torch
from model.training.memory import keep_freed_memory
if sys.argv[1] == "kept":
    assert keep_freed_memory()
for _ in range(30):  # until small blocks have found their places between the large ones
    torch.ones(16_000_000)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    torch.ones(16_000_000)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other allocators are left as they are")
def test_tensors_made_anew_cost_no_page_faults() -> None:
    """20 tensors of 64 MB: their pages are mapped once, not 20 times."""
    assert _page_faults("mapped") > 10 * _page_faults("kept")


def _page_faults(mode: str) -> int:
    ran = subprocess.run(
        [sys.executable, "-c", _PROBE, mode], check=True, capture_output=True, text=True, timeout=120
    )
    return int(ran.stdout)
