"""Attention as plain matrix products: faster than torch's fused kernel when training on a CPU in bfloat16.

There the fused kernel's backward pass takes several times as long as three batched products and a softmax:
52 against 8 ms for 64 pictures of 128 patches and 3 heads of 64 on one Zen 5 core. It is registered with
`transformers` under `MATMUL_ATTENTION`; a trainer switches the decoder's layers over by
``model.set_attn_implementation(MATMUL_ATTENTION)``.
"""

from __future__ import annotations

from typing import Any, Final

import torch
from torch import Tensor
from torch.nn import functional
from transformers import AttentionInterface, AttentionMaskInterface
from transformers.masking_utils import eager_mask

MATMUL_ATTENTION: Final = "looktwice_matmul"


def attend(query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None = None) -> Tensor:
    """Attention [..., t, d]; ``mask`` is added to the scores. Products where they pay, fused elsewhere."""
    dtype = torch.get_autocast_dtype("cpu") if torch.is_autocast_enabled("cpu") else query.dtype
    if query.device.type != "cpu" or dtype != torch.bfloat16 or not torch.is_grad_enabled():
        return functional.scaled_dot_product_attention(query, key, value, mask)
    query, key, value = query.to(dtype) * query.shape[-1] ** -0.5, key.to(dtype), value.to(dtype)
    scores = query @ key.transpose(-1, -2)
    if mask is not None:
        # Rounding float32's lowest number to bfloat16 gives -inf, and rows of nothing else become NaN.
        scores = scores + mask.to(dtype).clamp_min(torch.finfo(dtype).min)
    # Inside, softmax runs in float32; leaving autocast keeps its result in bfloat16.
    with torch.autocast("cpu", enabled=False):
        weights = scores.softmax(dim=-1)
        return weights @ value


def _attention_function(
    module: Any,
    query: Tensor,
    key: Tensor,
    value: Tensor,
    attention_mask: Tensor | None,
    **_: Any,
) -> tuple[Tensor, None]:
    """What `transformers` calls: query [b, h, t, d], key and value [b, g, s, d]; returns [b, t, h, d]."""
    batch, heads, length, width = query.shape
    groups = key.shape[1]
    # The heads that share keys become rows of one product.
    shared = query.view(batch, groups, heads // groups, length, width)
    mask = None if attention_mask is None else attention_mask[:, :, None]
    attended = attend(shared, key[:, :, None], value[:, :, None], mask)
    return attended.reshape(batch, heads, length, width).transpose(1, 2), None


AttentionInterface.register(MATMUL_ATTENTION, _attention_function)
AttentionMaskInterface.register(MATMUL_ATTENTION, eager_mask)
