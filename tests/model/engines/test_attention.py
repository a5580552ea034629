from __future__ import annotations

import pytest
import torch

from model.engines.torch.attention import attention_with_sums, plain_attention_with_sums
from model.engines.torch.runner import pass_size


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_fused_kernel_and_plain_operations_agree(dtype: torch.dtype, masked: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    query = torch.randn(3, 2, 5, 16, dtype=dtype, generator=generator)
    keys, values = (torch.randn(3, 2, 40, 16, dtype=dtype, generator=generator)[:, :, :9] for _ in range(2))
    mask = None
    if masked:
        seen = torch.rand(3, 1, 5, 9, generator=generator) < 0.6
        seen[..., 0] = True
        mask = torch.zeros(3, 1, 5, 9, dtype=dtype).masked_fill_(~seen, float("-inf"))
    fused, plain = (
        attend(query, keys, values, mask) for attend in (attention_with_sums, plain_attention_with_sums)
    )
    for one, other in zip(fused, plain, strict=True):
        torch.testing.assert_close(one, other)


def test_passes_have_few_sizes_and_little_padding() -> None:
    sizes = [pass_size(count) for count in range(1, 2001)]
    assert all(count <= size <= 1.25 * count for count, size in enumerate(sizes, start=1))
    assert sizes[:8] == list(range(1, 9))
    assert len(set(sizes)) < 50
