from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from transformers import DynamicCache, Qwen2_5_VLConfig

from looktwice.model.driving.scene import Scene
from looktwice.model.network.attention import MATMUL_ATTENTION, attend
from looktwice.model.network.checkpoint import Loaded
from looktwice.model.network.vision import attends_to_whole_pictures
from looktwice.model.network.vla import LookTwiceVla
from tests.model.network.conftest import made_up_scene


def batch_of(loaded: Loaded, scenes: list[Scene], response: int = 7) -> dict[str, Tensor]:
    """Prompts of one length with made-up responses, as keyword arguments of the network."""
    inputs = [loaded.inputs.build(scene, "cf_vla") for scene in scenes]
    random = np.random.default_rng(5)
    ids = np.stack([np.r_[one.prompt.ids, random.integers(0, 1000, response)] for one in inputs])
    return {
        "input_ids": torch.from_numpy(ids),
        "pixel_values_videos": torch.from_numpy(np.concatenate([one.patches for one in inputs])),
        "video_grid_thw": torch.from_numpy(np.concatenate([one.video_grid_thw for one in inputs])),
        "history": torch.tensor(np.stack([one.history for one in inputs])),
        "route": torch.tensor(np.stack([one.route for one in inputs if one.route is not None])),
    }


@pytest.fixture(scope="module")
def batch(nano64: Loaded) -> dict[str, Tensor]:
    return batch_of(nano64, [made_up_scene(1), made_up_scene(2)])


@torch.no_grad()
def test_stepwise_with_a_cache_equals_the_whole(nano64: Loaded, batch: dict[str, Tensor]) -> None:
    model: Any = nano64.model
    scene = made_up_scene(2)
    inputs = nano64.inputs.build(scene, "cf_vla")
    whole = model(**batch).logits[1, len(inputs.prompt.ids) - 1 :]
    prompt = model.encode_prompt_embeddings(inputs)
    cache = DynamicCache(config=model.config)
    step = model(
        inputs_embeds=prompt.embeddings[None],
        position_ids=prompt.position_ids[:, None],
        past_key_values=cache,
        use_cache=True,
    )
    logits = [step.logits[:, -1]]
    length = len(inputs.prompt.ids)
    for place in range(length, batch["input_ids"].shape[1]):
        position = torch.full((3, 1, 1), place + prompt.position_offset)
        token = batch["input_ids"][1:, place : place + 1]
        step = model(input_ids=token, position_ids=position, past_key_values=cache, use_cache=True)
        logits.append(step.logits[:, -1])
    torch.testing.assert_close(torch.cat(logits), whole, atol=1e-10, rtol=1e-8)


@torch.no_grad()
def test_positions_equal_those_of_transformers(nano64: Loaded, batch: dict[str, Tensor]) -> None:
    model: Any = nano64.model
    ids = batch["input_ids"]
    theirs, offset = model.model.get_rope_index(
        ids,
        mm_token_type_ids=2 * (ids == model.config.video_token_id).int(),
        video_grid_thw=batch["video_grid_thw"],
        second_per_grid_ts=[nano64.settings.seconds_per_slice] * 4,
    )
    torch.testing.assert_close(model.position_ids(ids), theirs)
    assert offset[0] == nano64.inputs.build(made_up_scene(1), "cf_vla").prompt.position_offset


@torch.no_grad()
def test_padding_changes_nothing(nano64: Loaded, batch: dict[str, Tensor]) -> None:
    model: Any = nano64.model
    plain = model(**batch).logits
    for side in ("left", "right"):
        pad = torch.full((2, 5), 3)
        zero, ones = torch.zeros(2, 5), torch.ones(batch["input_ids"].shape)
        parts = [pad, batch["input_ids"]], [zero, ones]
        ids, mask = (torch.cat(part if side == "left" else part[::-1], dim=1) for part in parts)
        padded = model(**{**batch, "input_ids": ids}, attention_mask=mask.long()).logits
        kept = padded[:, 5:] if side == "left" else padded[:, :-5]
        torch.testing.assert_close(kept, plain, atol=1e-10, rtol=1e-8)


@torch.no_grad()
def test_fast_vision_equals_the_original(nano64: Loaded, batch: dict[str, Tensor]) -> None:
    model: Any = nano64.model
    patches, grid = batch["pixel_values_videos"], batch["video_grid_thw"]
    fast = model.vision(patches, grid)
    inputs = nano64.inputs.build(made_up_scene(1), "cf_vla")
    normalised = torch.from_numpy(inputs.pixel_values_videos)
    features = model.model.get_video_features(normalised.double(), grid[:2], return_dict=True).pooler_output
    original = torch.cat(tuple(features))
    torch.testing.assert_close(fast[: len(original)], original, atol=1e-6, rtol=1e-5)
    # Clips can be kept: alone they give what they give in a batch.
    torch.testing.assert_close(model.vision(patches[512:], grid[2:]), fast[128:], atol=1e-10, rtol=1e-8)


@torch.no_grad()
def test_mixed_sizes_take_the_original_way(nano64: Loaded) -> None:
    model: Any = nano64.model
    patches = torch.randn(2 * 8 + 4 * 4, 1176, dtype=torch.float64)
    tokens = model.vision(patches, torch.tensor([[2, 2, 4], [1, 4, 4]]))
    torch.testing.assert_close(tokens[:4], model.vision(patches[:16], torch.tensor([[2, 2, 4]])))
    assert not attends_to_whole_pictures(Qwen2_5_VLConfig().vision_config)


@torch.no_grad()
def test_history_and_route_matter_where_they_stand(nano64: Loaded, batch: dict[str, Tensor]) -> None:
    model: Any = nano64.model
    ids = batch["input_ids"]
    for name, token in (("history", model.history_token_id), ("route", model.route_token_id)):
        place = int((ids[0] == token).nonzero())
        plain = model.embed(ids, history=batch["history"], route=batch["route"])
        moved = model.embed(ids, **{**batch_part(batch), name: batch[name] + 1})
        changed = (plain != moved).any(dim=-1)
        assert changed[:, place].all()
        assert changed.sum() == 2
    # A route given to a prompt without its token is ignored.
    bare = ids.clone()
    bare[bare == model.route_token_id] = 0
    without, ignored = model.embed(bare), model.embed(bare, route=batch["route"])
    torch.testing.assert_close(without, ignored)


def batch_part(batch: dict[str, Tensor]) -> dict[str, Tensor]:
    return {"history": batch["history"], "route": batch["route"]}


def test_everything_learns(nano64: Loaded, batch: dict[str, Tensor]) -> None:
    model: Any = nano64.model
    output = model(**batch, labels=batch["input_ids"])
    output.loss.backward()
    without = [name for name, parameter in model.named_parameters() if parameter.grad is None]
    model.zero_grad()
    assert not without


@torch.no_grad()
def test_generates_with_transformers(nano64: Loaded) -> None:
    model: Any = nano64.model
    given = batch_of(nano64, [made_up_scene(1)], response=0)
    ours: list[int] = []
    for _ in range(4):
        ids = torch.cat([given["input_ids"], torch.tensor([ours], dtype=torch.int64)], dim=1)
        ours.append(int(model(**{**given, "input_ids": ids}).logits[0, -1].argmax()))
    theirs = model.generate(
        **given,
        attention_mask=torch.ones_like(given["input_ids"]),
        max_new_tokens=4,
        min_new_tokens=4,
        do_sample=False,
    )
    assert theirs[0, -4:].tolist() == ours


@pytest.mark.parametrize("masked", [False, True])
def test_matmul_attention_equals_the_fused_one(masked: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    query, key, value = (
        torch.randn(2, 3, 9, 16, generator=generator).bfloat16().requires_grad_() for _ in range(3)
    )
    mask = torch.full((9, 9), torch.finfo(torch.float32).min).triu(1) if masked else None
    ours = attend(query, key, value, mask)
    fused = torch.nn.functional.scaled_dot_product_attention(
        query, key, value, None if mask is None else mask.bfloat16()
    )
    torch.testing.assert_close(ours, fused, atol=2e-2, rtol=2e-2)
    assert torch.isfinite(torch.autograd.grad(ours.float().sum(), query)[0]).all()


def test_matmul_attention_in_the_network(nano64: Loaded, batch: dict[str, Tensor]) -> None:
    model: Any = LookTwiceVla(nano64.model.config)
    model.float().load_state_dict(nano64.model.state_dict())
    mask = torch.ones_like(batch["input_ids"])
    mask[0, -3:] = 0
    with torch.autocast("cpu", torch.bfloat16):
        fused = model(**batch, attention_mask=mask).logits.float()
        model.set_attn_implementation(MATMUL_ATTENTION)
        ours = model(**batch, attention_mask=mask).logits.float()
    model.set_attn_implementation("sdpa")
    kept = mask.bool()
    torch.testing.assert_close(ours[kept], fused[kept], atol=0.05, rtol=0.05)
