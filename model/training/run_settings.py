"""How a recipe is run, apart from what decides its outcome."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import torch


@dataclass(frozen=True)
class RunSettings:
    """How a recipe is run, apart from what decides its outcome.

    Attributes:
        cache: folder for scenes brought into arrays.
        validate_every, save_every: steps.
        draws: per scene in validation.
        bf16: mixed precision.
        compiled: compile the decoder; pays after a few hundred steps.
        use_cpu: stay off accelerators.
        workers: processes that make examples into batches beside the training. Grounding on CPUs has at
            least one: decoding pictures for the tower takes a third of a step there. On an accelerator
            they decode all pictures before it begins.
    """

    cache: Path
    validate_every: int = 500
    save_every: int = 250
    draws: int = 6
    bf16: bool = True
    compiled: bool = False
    use_cpu: bool = True
    workers: int = 0

    @property
    def device(self) -> torch.device:
        """Where to train; of several processes each has a device of its own."""
        if self.use_cpu or not torch.cuda.is_available():
            return torch.device("cpu")
        return torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))
