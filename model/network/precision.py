"""What a machine multiplies fast."""

from __future__ import annotations

from typing import Any

import torch


def bfloat16_is_fast(device: str = "cpu") -> bool:
    """Whether matrices of bfloat16 are multiplied faster than of float32.

    They are on accelerators, and on CPUs with units for it (AMX, AVX-512 BF16); others are many times slower.
    """
    if device != "cpu":
        return True
    # Known from torch 2.12 on; before, nothing is known.
    capabilities: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    return bool(capabilities.get("amx_bf16") or capabilities.get("avx512_bf16"))


def has_bfloat16_layout() -> bool:
    """Whether oneDNN can lay weights in bfloat16 out for this CPU (AVX-512 or AVX-NE-CONVERT; not AVX2)."""
    return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())


def fast_dtype(device: str = "cpu") -> torch.dtype:
    """The type whose matrices a device multiplies fastest: bfloat16 or float32."""
    return torch.bfloat16 if bfloat16_is_fast(device) else torch.float32
