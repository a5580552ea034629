"""What a plan must cost at least: bytes to move and arithmetic, against what this machine can do."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

_SECONDS = 0.5
"""Of each measurement."""


@dataclass(frozen=True)
class Machine:
    """What was measured here: copying memory, and products of large matrices in ``dtype``."""

    copy_bytes_per_s: float
    flops_per_s: float
    dtype: str
    device: str


@dataclass(frozen=True)
class PlanCost:
    """What a plan takes: floating-point operations, and bytes moved.

    Weights are moved once a pass and shared by all scenes in it; a scene's keys and values are moved once
    in each pass that it takes part in. Nothing that was fed in vain is counted.
    """

    flops: float
    bytes: float

    def seconds(self, machine: Machine) -> float:
        """The least time for it: arithmetic and memory at once, each at full speed."""
        return max(self.flops / machine.flops_per_s, self.bytes / machine.copy_bytes_per_s)


def measure(device: str, dtype: torch.dtype) -> Machine:
    """Measure this machine; takes a second."""
    source = torch.empty(1 << 26, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    copies_per_s = _rate(lambda: target.copy_(source), device)
    matrix = torch.randn(2048, 2048, dtype=torch.float32, device=device).to(dtype)
    products_per_s = _rate(lambda: matrix @ matrix, device)
    return Machine(
        2 * source.numel() * copies_per_s,
        2 * 2048**3 * products_per_s,
        str(dtype).removeprefix("torch."),
        device,
    )


def _rate(act: Callable[[], Any], device: str) -> float:
    """How often ``act`` can be done in a second."""
    wait: Callable[[], Any] = torch.cuda.synchronize if device != "cpu" else lambda: None
    act()
    wait()
    count, began_s = 0, time.perf_counter()
    while time.perf_counter() - began_s < _SECONDS:
        act()
        wait()
        count += 1
    return count / (time.perf_counter() - began_s)


def work_of_plan(
    config: Any,
    prompt_tokens: int,
    patches: int,
    *,
    tokens: float,
    passes: float,
    scene_passes: float,
    together: int,
    dtype: torch.dtype,
) -> PlanCost:
    """A plan's work.

    Args:
        config: of the checkpoint's network.
        prompt_tokens: of its scene.
        patches: of its pictures.
        tokens: behind the prompt that had to go through the decoder, over all draws.
        passes: that they took, a pass with several scenes shared out among these.
        scene_passes: that its scene took part in.
        together: scenes whose prompts may share a pass.
        dtype: of weights, keys and values.
    """
    text, vision, size = config.text_config, config.vision_config, dtype.itemsize
    head_dim = text.hidden_size // text.num_attention_heads
    kv = 2 * text.num_key_value_heads * head_dim
    layer = text.hidden_size * (text.hidden_size * 2 + kv) + 3 * text.hidden_size * text.intermediate_size
    decoder = text.num_hidden_layers * layer
    block = 4 * vision.hidden_size**2 + 3 * vision.hidden_size * vision.intermediate_size
    tower = vision.depth * block
    seen = 4 * text.num_hidden_layers * text.hidden_size  # of a token, for each that it sees
    flops = (
        2.0 * tower * patches
        + 2.0 * decoder * (prompt_tokens + tokens)
        + seen * (prompt_tokens**2 / 2 + tokens * prompt_tokens)
    )
    held = text.num_hidden_layers * kv * prompt_tokens
    moved = (tower + decoder) / together + decoder * passes + held * scene_passes
    return PlanCost(flops, float(size * moved))
