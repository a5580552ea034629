from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path

import torch

from looktwice.model.bench.presets import PRESETS, Preset, write_random
from looktwice.model.bench.roofline import PlanCost, work_of_plan
from looktwice.model.engines.engine import Controls, DrawFinished, PlanRequest
from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.model.network.checkpoint import read_config
from tests.checkpoints import noisy_scene


def small(preset: Preset) -> Preset:
    """The same layout, windowed vision blocks included, in a size for tests."""
    return Preset(
        text=preset.text
        | {"vocab_size": 1, "hidden_size": 256, "intermediate_size": 128, "num_hidden_layers": 2},
        vision=preset.vision
        | {"depth": 2, "hidden_size": 128, "intermediate_size": 64, "num_heads": 4, "out_hidden_size": 256}
        | {"fullatt_block_indexes": [1]},
        image_width=112,
        image_height=56,
    )


def test_a_preset_plans_with_random_weights(untrained_checkpoint: Path, tmp_path: Path) -> None:
    preset = small(PRESETS["cf-vla-3b"])
    preset = replace(preset, text=preset.text | {"num_attention_heads": 2, "num_key_value_heads": 1})
    write_random(preset, untrained_checkpoint, tmp_path / "small")

    async def plan() -> int:
        engine = TorchEngine(tmp_path / "small", TorchSettings(rows=4))
        await engine.start()
        try:
            request = PlanRequest("a", noisy_scene(), "cf_vla", controls=Controls(n=2, thinking="never"))
            return sum([isinstance(event, DrawFinished) async for event in engine.submit(request)])
        finally:
            await engine.stop()

    assert asyncio.run(plan()) == 2


def test_work_grows_with_what_is_done(untrained_checkpoint: Path) -> None:
    config = read_config(untrained_checkpoint)

    def work(
        tokens: float = 50,
        passes: float = 10,
        scene_passes: float = 10,
        together: int = 1,
        dtype: torch.dtype = torch.float32,
    ) -> PlanCost:
        return work_of_plan(
            config,
            100,
            200,
            tokens=tokens,
            passes=passes,
            scene_passes=scene_passes,
            together=together,
            dtype=dtype,
        )

    assert work(tokens=100).flops > work().flops
    assert work(passes=20).bytes > work().bytes
    assert work(scene_passes=20).bytes > work().bytes
    assert work(dtype=torch.bfloat16).bytes == work().bytes / 2
    shared = work(passes=1, together=10)
    assert shared.flops == work().flops
    assert shared.bytes < work().bytes
