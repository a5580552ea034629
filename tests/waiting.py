"""Waiting for what must come."""

from __future__ import annotations

import time
from collections.abc import Callable

from tests.sockets import PATIENCE_S


def until(condition: Callable[[], bool], patience_s: float = PATIENCE_S, every_s: float = 0.01) -> None:
    """Wait until ``condition`` holds, asked every so often; fails when it does not come to."""
    for _ in range(round(patience_s / every_s)):
        if condition():
            return
        time.sleep(every_s)
    raise AssertionError("what was waited for did not happen")
