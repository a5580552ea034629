from __future__ import annotations

from pathlib import Path

from looktwice.model.bench.rounding import measure
from tests.checkpoints import noisy_scene


def test_a_format_without_a_branch_is_measured_as_it_is(refining_checkpoint: Path) -> None:
    single, half = measure(refining_checkpoint, [noisy_scene()], n=1)
    assert single.responses == half.responses == 1


def test_rounding_changes_close_decisions_only(untrained_checkpoint: Path) -> None:
    single, half = measure(untrained_checkpoint, [noisy_scene(k) for k in range(4)], n=3)
    assert (single.name, half.name) == ("float32", "bfloat16")
    assert single.responses == half.responses == 12
    assert single.different == len(single.margins)
    assert all(margin < 1e-3 for margin in single.margins)
    assert half.different >= single.different
    assert all(margin < 0.1 for margin in half.margins)
