"""The decoder that all others are compared with: one draw, one token at a time, by `transformers` alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor, nn

from looktwice.model.engines.engine import Draw, PlanRequest
from looktwice.model.engines.engine_requests import decided, fixed_values, given_plans, read
from looktwice.model.engines.sampling import probabilities
from looktwice.model.engines.transformers.own_network import OwnNetwork
from looktwice.model.engines.transformers.plain_decoder import PlainDecoder
from looktwice.model.families.family import Family
from looktwice.model.families.registry import families_of
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.network.checkpoint import Loaded


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
    controls, decoding = request.controls, PlainDecoder(OwnNetwork(loaded))
    inputs = loaded.inputs.build(request.scene, request.format, request.attempt, controls.view)
    compiled = CompiledFormat(family.format, loaded.vocabulary)
    expected = loaded.inputs.expected(request.scene, controls.view)
    start = compiled.start(
        given_plans(request, family), decided(request, family), fixed_values(request, family, expected)
    )
    asked = decoding.begin(request, family, start, inputs)
    shares: Shares = {}
    for position, step in enumerate(decoding.write(asked, index)):
        if len(step.logits) > 1:
            shares[position] = probabilities(step.logits)
    parts = loaded.vocabulary, loaded.codec, asked.reason_mask
    [draw] = read(request, family, step.response, position + 1, (index,), *parts)
    return draw, shares
