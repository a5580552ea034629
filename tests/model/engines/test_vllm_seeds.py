"""What the vLLM engine works out without vLLM."""

from __future__ import annotations

from looktwice.model.engines.engine import MAX_DRAWS
from looktwice.model.engines.vllm.decoding import seed_of


def test_neighbouring_seeds_share_no_draws() -> None:
    seeds = [0, 1, 2, 1 << 63, (1 << 63) + 3, (1 << 64) - 1]
    used = [seed_of(seed, 0, written) + draw for seed in seeds for written in (0, 5) for draw in range(6)]
    # 2 ** 63 stands for the same seed as 0.
    assert len(set(used)) == len(used) - 12


def test_seeds_are_within_what_vllm_takes() -> None:
    for seed in (0, 7, (1 << 64) - 1):
        assert 0 <= seed_of(seed, 3, 100) < 2**63 - MAX_DRAWS
