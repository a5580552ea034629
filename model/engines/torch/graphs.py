"""Passes that are captured and replayed: launched at once, not operation by operation.

A pass of few tokens through many layers is a thousand short operations, and starting one costs a GPU's host
more than the GPU needs for it (CUDA graphs, https://pytorch.org/docs/stable/notes/cuda.html#cuda-graphs).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, NamedTuple, Protocol

import torch
from torch import Tensor

from looktwice.model.engines.torch.layout import Part

LIMIT: Final = 512
"""Sizes that are captured; each takes a fraction of a second and some memory."""


class Sizes(NamedTuple):
    """What passes have in common that do the same to other numbers.

    Attributes:
        parts: of their layout.
        numbers: how many of which.
    """

    parts: tuple[Part, ...]
    numbers: tuple[int, ...]


class Numbers(NamedTuple):
    """What tells a pass from others of its sizes: whole numbers, int64, and masked slots, bool."""

    whole: Tensor
    masked: Tensor


class Captured(Protocol):
    """A pass that reads its numbers where they were when it was captured."""

    @property
    def result(self) -> Tensor:
        """What it made last; overwritten by the next replay."""
        ...

    def replay(self) -> None:
        """Do it again."""
        ...


Run = Callable[[Sizes, Numbers], Tensor]
Capture = Callable[[Callable[[], Tensor]], Captured]


class CudaGraph:
    """A `Captured` on the present CUDA device; all of a process share the memory between operations.

    Args:
        run: what is captured; it must have run before, with other numbers, and must not wait for the device.
    """

    _pool: Any = None

    def __init__(self, run: Callable[[], Tensor]) -> None:
        if CudaGraph._pool is None:
            CudaGraph._pool = torch.cuda.graph_pool_handle()
        self._graph = torch.cuda.CUDAGraph()
        # Another thread, which loads the next model, may use the device meanwhile.
        with torch.cuda.graph(self._graph, pool=CudaGraph._pool, capture_error_mode="thread_local"):
            self.result = run()

    def replay(self) -> None:
        """See `Captured.replay`."""
        self._graph.replay()


class Graphs:
    """Makes passes; the second of the same sizes is captured, and replayed for all that come behind it.

    Args:
        run: makes a pass.
        capture: captures one.
    """

    def __init__(self, run: Run, capture: Capture) -> None:
        self._run, self._capture = run, capture
        self._met: set[Sizes] = set()
        self._captured: dict[Sizes, tuple[Numbers, Captured]] = {}

    def __call__(self, sizes: Sizes, numbers: Numbers) -> Tensor:
        """What ``run`` makes of ``numbers``; valid until the next call."""
        if sizes not in self._captured:
            if sizes not in self._met or len(self._captured) == LIMIT:
                self._met.add(sizes)
                return self._run(sizes, numbers)
            own = Numbers(*(part.clone() for part in numbers))
            self._captured[sizes] = own, self._capture(lambda: self._run(sizes, own))
        own, captured = self._captured[sizes]
        for kept, new in zip(own, numbers, strict=True):
            kept.copy_(new)
        captured.replay()
        return captured.result
