from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from looktwice.model.engines.torch import graphs
from looktwice.model.engines.torch.decoder import Decoder
from looktwice.model.engines.torch.graphs import Capture, Captured, CudaGraph, Graphs, Numbers, Sizes
from looktwice.model.engines.torch.layout import Part
from looktwice.model.engines.torch.runner import Runner
from looktwice.model.network.checkpoint import Loaded, load
from tests.model.engines.decoding import Again, decode, request

SMALL, LARGE = (Sizes((Part(0, 1, 1, 32),), (count,)) for count in (2, 5))


class Passes:
    """Adds its numbers up, and counts what is run and what is captured."""

    def __init__(self) -> None:
        self.run, self.captured = 0, 0

    def __call__(self, sizes: Sizes, numbers: Numbers) -> Tensor:
        assert sizes.numbers == (len(numbers.whole),)
        self.run += 1
        return numbers.whole[~numbers.masked].sum()[None]

    def capture(self, run: Callable[[], Tensor]) -> Captured:
        self.captured += 1
        return Again(run)


def numbers(*values: int) -> Numbers:
    whole = torch.tensor(values)
    return Numbers(whole, whole < 0)


def test_the_second_pass_of_its_sizes_is_captured_and_reads_what_comes_later() -> None:
    passes = Passes()
    made = Graphs(passes, passes.capture)
    found = [int(made(SMALL, numbers(k, -k))) for k in (1, 2, 3, 4)]
    found += [int(made(LARGE, numbers(1, 1, 1, 1, 1)))]
    assert found == [1, 2, 3, 4, 5]
    assert passes.captured == 1


def test_so_many_sizes_are_captured_and_others_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graphs, "LIMIT", 1)
    passes = Passes()
    made = Graphs(passes, passes.capture)
    for _ in range(3):
        assert int(made(SMALL, numbers(1, 2))) == 3
        assert int(made(LARGE, numbers(1, 1, 1, 1, 1))) == 5
    assert passes.captured == 1


def plans(loaded: Loaded, capture: Capture | None) -> list[str]:
    with torch.inference_mode():
        decoder = Decoder(Runner(loaded, 13, clip_bytes=1 << 20, capture=capture))
        texts = []
        for seed in range(3):  # later ones are replayed
            draws = decode(decoder, *(request(f"{scene}", scene, n=3, seed=seed) for scene in range(2)))
            texts += [draws[key].text for key in sorted(draws)]
    return texts


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_captured_passes_write_what_others_write(untrained_checkpoint: Path) -> None:
    loaded = load(untrained_checkpoint, torch.float64, "cuda")
    assert plans(loaded, CudaGraph) == plans(loaded, None)


def test_most_passes_are_like_one_before(exact: Loaded) -> None:
    captured = []

    def capture(run: Callable[[], Tensor]) -> Captured:
        captured.append(Again(run))
        return captured[-1]

    assert plans(exact, capture) == plans(exact, None)
    assert captured
