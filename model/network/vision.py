"""A faster way through Qwen2.5-VL's vision tower for clips of one size; same weights, same result.

`transformers` runs attention picture by picture in a Python loop and embeds patches by a 3D convolution.
Where all clips have one grid and every block attends to whole pictures, pictures are simply a batch and
the convolution a matrix product. Other towers (windowed attention, mixed sizes) take the original way.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from looktwice.model.network.attention import attend
from looktwice.model.network.patches import normalisation


def attends_to_whole_pictures(vision_config: Any) -> bool:
    """Whether no block of the tower uses windowed attention."""
    return set(range(vision_config.depth)) <= set(vision_config.fullatt_block_indexes)


def normalised(patches: Tensor) -> Tensor:
    """uint8 patches [p, n] as the normalised float32 patches that the tower was made for."""
    scale, shift = (torch.from_numpy(part).to(patches.device) for part in normalisation(patches.shape[-1]))
    return patches.float() * scale + shift


def encode_pictures(visual: Any, patches: Tensor, rows: int, columns: int) -> Tensor:
    """Vision tokens [k x rows x columns / merge^2, out] of k equal pictures (time slices).

    Args:
        visual: `Qwen2_5_VisionTransformerPretrainedModel` for which `attends_to_whole_pictures` holds.
        patches: [k x rows x columns, 3 x temporal x patch x patch] in the processor's order: floats that are
            normalised, or uint8 as they are.
        rows, columns: patches per picture.
    """
    weight, bias = visual.patch_embed.proj.weight.flatten(1), None
    if patches.dtype == torch.uint8:
        # Normalising is linear too: cheaper done to the weights than to all patches.
        scale, shift = (torch.from_numpy(part).to(weight) for part in normalisation(patches.shape[1]))
        weight, bias = weight * scale, weight @ shift
    x = functional.linear(patches.to(weight.dtype), weight, bias)
    tokens = rows * columns
    x = x.view(-1, tokens, x.shape[-1])
    cos, sin = _rotation(visual, rows, columns, x)
    for block in visual.blocks:
        x = x + _attention(block.attn, _norm(block.norm1, x), cos, sin)
        x = x + block.mlp(_norm(block.norm2, x))
    merger = visual.merger
    merged: Tensor = merger.mlp(_norm(merger.ln_q, x).reshape(-1, merger.hidden_size))
    return merged


def _norm(module: Any, x: Tensor) -> Tensor:
    # One fused pass instead of five; in float32 inside, as the original.
    return functional.rms_norm(x, (x.shape[-1],), module.weight.to(x.dtype), module.variance_epsilon)


def _attention(module: Any, x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    pictures, tokens, width = x.shape
    qkv = module.qkv(x).view(pictures, tokens, 3, module.num_heads, width // module.num_heads)
    query, key, value = qkv.permute(2, 0, 3, 1, 4).unbind(0)
    attended = attend(_rotate(query, cos, sin), _rotate(key, cos, sin), value)
    projected: Tensor = module.proj(attended.transpose(1, 2).reshape(pictures, tokens, width))
    return projected


def _rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    half = x.shape[-1] // 2
    first, second = x[..., :half], x[..., half:]
    return torch.cat([first * cos - second * sin, second * cos + first * sin], dim=-1)


def _rotation(visual: Any, rows: int, columns: int, x: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine and sine [rows x columns, head_dim / 2] of the row and column angles, in merged order."""
    merge = visual.spatial_merge_size
    config = visual.config
    quarter = config.hidden_size // config.num_heads // 4
    theta = (getattr(config, "rope_parameters", None) or {}).get("rope_theta", 10000.0)
    exact = torch.promote_types(x.dtype, torch.float32)
    frequency = theta ** (-torch.arange(quarter, device=x.device, dtype=exact) / quarter)
    row, column = torch.meshgrid(
        torch.arange(rows, device=x.device), torch.arange(columns, device=x.device), indexing="ij"
    )
    places = torch.stack([row, column]).view(2, rows // merge, merge, columns // merge, merge)
    places = places.permute(1, 3, 2, 4, 0).reshape(-1, 2)
    angle = (places[..., None] * frequency).flatten(1)
    return angle.cos().to(x.dtype), angle.sin().to(x.dtype)
