"""Between turns: what one engine still does behind its answer must not be told of the next."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from looktwice.model.engines.torch.threads import CpuTimes, cpu_times

_LOOK_S: Final = 0.25
_IDLE: Final = 0.1
"""Of a core, that a machine at rest uses."""
_MAX_WAIT_S: Final = 3.0


def wait_until_quiet(
    read: Callable[[], CpuTimes | None] = cpu_times, sleep: Callable[[float], None] = time.sleep
) -> bool:
    """Wait for other processes to leave the processors.

    A worker of vLLM keeps a core busy for a second after its last answer, waiting for more; an engine that is
    asked meanwhile has one core less.

    Returns:
        Whether they did: not where the kernel does not tell, nor where they went on for 3 s.
    """
    before = read()
    for _ in range(round(_MAX_WAIT_S / _LOOK_S)):
        if before is None:
            return False
        sleep(_LOOK_S)
        now = read()
        if now is not None and now.others_s - before.others_s < _IDLE * _LOOK_S:
            return True
        before = now
    return False
