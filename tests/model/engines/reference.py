"""The decoder that all others are compared with: one draw, one token at a time, by `transformers` alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from transformers import DynamicCache

from model.driving.plan import Plan
from model.engines.binding import binding_of
from model.engines.engine import Draw, PlanRequest
from model.engines.least_error import LeastError, least_error
from model.engines.reason_mask import reason_mask_of
from model.engines.sampling import choose, probabilities, uniform
from model.families.family import Family
from model.families.registry import families_of
from model.formats.cursor import CompiledFormat, Token
from model.formats.text import parse
from model.network.checkpoint import Loaded


class _ExactRotary(nn.Module):
    """Rotary embedding in float64; in float32 cosines differ by a bit with where they lie in memory."""

    def __init__(self, theirs: Any) -> None:
        super().__init__()
        self._theirs = theirs

    def forward(self, x: Tensor, position_ids: Tensor) -> tuple[Tensor, Tensor]:
        angles = position_ids.expand(3, -1, -1)[..., None] * self._theirs.inv_freq.double()
        cosines, sines = (
            self._theirs.recomposition_frequencies(each) for each in (angles.cos(), angles.sin())
        )
        return cosines, sines


def exactly(loaded: Loaded) -> Loaded:
    """``loaded``, in float64, with nothing that rounds to float32 on the way."""
    text: Any = loaded.model.model.language_model
    text.rotary_emb = _ExactRotary(text.rotary_emb)
    for module in list(loaded.model.modules()):
        for name, child in list(module.named_children()):
            theirs: Any = child
            if type(theirs).__name__ == "Qwen2_5_VLRMSNorm":
                epsilon = theirs.variance_epsilon
                norm: Any = nn.RMSNorm(len(theirs.weight), eps=epsilon, dtype=theirs.weight.dtype)
                norm.weight, norm.variance_epsilon = theirs.weight, epsilon
                setattr(module, name, norm)
    return loaded


Shares = dict[int, npt.NDArray[np.float64]]
"""Of each decision, by its position, the probabilities of the tokens that were allowed."""


def reference_draws(
    loaded: Loaded, request: PlanRequest, families: Mapping[str, Family] | None = None
) -> list[Draw]:
    """All draws of a request, each from its own prompt."""
    families = families or families_of(loaded.card.formats, loaded.settings.reflection)
    return [draw for draw, _ in reference(loaded, request, families)]


def reference(
    loaded: Loaded, request: PlanRequest, families: Mapping[str, Family]
) -> list[tuple[Draw, Shares]]:
    """The same, with what each draw had to choose from."""
    family = families[request.format]
    return [_draw(loaded, request, family, index) for index in range(request.controls.n)]


def _draw(loaded: Loaded, request: PlanRequest, family: Family, index: int) -> tuple[Draw, Shares]:
    model: Any = loaded.model
    controls = request.controls
    inputs = loaded.inputs.build(request.scene, request.format, request.attempt, controls.camera)
    prompt = model.encode_prompt_embeddings(inputs)
    cache = DynamicCache(config=model.config)
    logits = model(
        inputs_embeds=prompt.embeddings[None],
        position_ids=prompt.position_ids[:, None],
        past_key_values=cache,
        use_cache=True,
    ).logits[0, -1]
    given: dict[str, Plan] = {}
    if controls.prefill is not None and family.first_plan is not None:
        given[family.first_plan] = controls.prefill
    compiled = CompiledFormat(family.format, loaded.vocabulary)
    imagination = family.imagination
    cursor = compiled.start(given, imagination.picks(None, controls.camera) if imagination else None)
    tokens: list[Token] = []
    binding = binding_of(request, loaded.codec, loaded.vocabulary)
    facts = model.read_facts(prompt.embeddings[inputs.prompt.ids == model.config.video_token_id])
    reason_mask = reason_mask_of(request, family, loaded.vocabulary, facts)
    least = LeastError(loaded.codec, loaded.vocabulary)
    think_probability = None
    shares: Shares = {}
    while not cursor.done:
        allowed = cursor.allowed()
        scores = logits.double().numpy()[allowed.ids]
        left = np.ones(len(allowed.ids), np.bool_)
        if len(allowed.ids) > 1:
            shares[len(tokens)] = probabilities(scores)
        if family.branch is not None and allowed.choice == family.branch.name and len(allowed.ids) > 1:
            reflecting = family.branch.reflecting
            thinks = np.array([reflecting in cursor.option_texts(int(id)) for id in allowed.ids])
            think_probability = float(probabilities(scores)[thinks].sum())
            if controls.thinking != "adaptive":
                left = thinks == (controls.thinking == "always")
            elif controls.think_threshold is not None:
                left = thinks == (think_probability > controls.think_threshold)
        if imagination is not None and allowed.choice == imagination.name and controls.imagine != "auto":
            wanted = imagination.imagined if controls.imagine == "always" else imagination.unseen
            left = np.array([wanted in cursor.option_texts(int(id)) for id in allowed.ids])
        if binding is not None and (bound := binding.leaves(allowed.ids, tokens, family.plans)) is not None:
            left = bound
        if reason_mask is not None and (named := reason_mask.leaves(cursor, tokens)) is not None:
            left = named
        expected = least.expected(allowed, controls)
        number = np.array([uniform(controls.seed, index, len(tokens))])
        if expected is None:
            place = choose(scores[left], controls.temperature, controls.top_p, number)[0]
            token = int(allowed.ids[left][place])
        else:
            token = int(allowed.ids[least_error(scores, expected, left)])
        place = len(inputs.prompt.ids) + len(tokens)
        tokens.append(Token(token, cursor.section))
        cursor = cursor.advance(token)
        logits = model(
            input_ids=torch.tensor([[token]]),
            position_ids=torch.full((3, 1, 1), place + prompt.position_offset),
            past_key_values=cache,
            use_cache=True,
        ).logits[0, -1]
    text = loaded.vocabulary.decode([token.id for token in tokens])
    history = request.scene.history[None]
    values = parse(compiled, text, given)
    reading = family.read(values, lambda codes: loaded.codec.decode(history, [codes])[0])
    draw = Draw(
        index=index,
        text=text,
        plan=reading.plan,
        branch=reading.branch,
        think_probability=think_probability,
        thinking=family.reflected(values),
        revised_plan=reading.revised_plan,
        trajectory=reading.trajectory,
        codes=reading.codes,
        tokens=dict(Counter(token.section for token in tokens)),
    )
    return draw, shares
