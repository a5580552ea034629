"""The language model's layers over packed tokens: no batch dimension, nothing padded, few operations.

Same weights and results as `transformers`' Qwen2.5-VL text model, whose modules cost more in calls than in
arithmetic when a step feeds a handful of tokens, and more in padding when it feeds many.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple, Protocol

import torch
from torch import Tensor
from torch.nn import functional

from looktwice.model.network.precision import has_bfloat16_layout


class Attention(Protocol):
    """Where a pass's keys and values go, and what its queries see."""

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """[t, h x d] for scaled queries [t, h, d] and keys and values [t, g, d]."""
        ...


class Rotation(NamedTuple):
    """Rotary embedding of tokens: cosines and signed sines, each [t, 1, d]."""

    cosines: Tensor
    sines: Tensor

    def at(self, places: Tensor) -> Rotation:
        """The rows ``places``."""
        return Rotation(self.cosines.index_select(0, places), self.sines.index_select(0, places))

    def __call__(self, x: Tensor) -> Tensor:
        """``x`` [t, heads, d] turned."""
        turned = x.roll(x.shape[-1] // 2, dims=-1).mul_(self.sines)
        return turned.addcmul_(x, self.cosines)


_ONE_SUM: Final = 256
"""So many numbers in bfloat16 oneDNN adds up in one order, whatever stands beside them; longer sums by how
many rows there are (sums of 768, on AMX)."""


class _Product:
    """``x @ weight.T + bias``, the weight laid out once as products read it, and not in every call.

    In bfloat16 on most CPUs that is as their matrix units do (oneDNN's own layout, as `torch.compile` does
    when it freezes weights); else turned over, which takes half of the time where tokens are few. But MKL's
    sums in float32 depend on how many rows there are (without AVX-512), and oneDNN's do not.

    Args:
        weight: [n, m].
        bias: [n].
        repeatable: each row's numbers are the same to the last bit, however many rows there are.
    """

    def __init__(self, weight: Tensor, bias: Tensor | None = None, *, repeatable: bool = False) -> None:
        self.width = weight.shape[1]
        self._bias = bias
        pays = {torch.bfloat16: has_bfloat16_layout(), torch.float32: repeatable}
        self._by_onednn = weight.device.type == "cpu" and pays.get(weight.dtype, False)
        self._sums = [self.width]
        if not self._by_onednn:
            self._weights = [weight.t().contiguous()]
            return
        if repeatable and weight.dtype == torch.bfloat16 and self.width > _ONE_SUM:
            self._sums = [min(_ONE_SUM, self.width - at) for at in range(0, self.width, _ONE_SUM)]
        parts = [part.contiguous() for part in torch.split(weight, self._sums, dim=1)]
        self._weights = [torch.ops.mkldnn._reorder_linear_weight(part) for part in parts]

    def __call__(self, x: Tensor) -> Tensor:
        """[t, n] of x [t, m], in its type; where sums are made in parts, these are added up in float32."""
        first, *others = self._weights
        if not self._by_onednn:
            return torch.mm(x, first) if self._bias is None else torch.addmm(self._bias, x, first)
        if not others:
            return _onednn(x, first, self._bias)
        part, *parts = torch.split(x, self._sums, dim=1)
        total = _onednn(part, first, self._bias).float()
        for part, weight in zip(parts, others, strict=True):
            total += _onednn(part, weight, None)
        return total


def _onednn(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """``x`` [t, m] by a weight that oneDNN has laid out."""
    made: Tensor = torch.ops.mkldnn._linear_pointwise.default(x, weight, bias, "none", [], "")
    return made


class _Layer(NamedTuple):
    qkv: _Product
    out: _Product
    gate_up: _Product
    down: _Product


class PackedDecoder:
    """The decoder of a loaded network, for inference. Its projections are copies, joined into few products.

    Args:
        text_model: `Qwen2_5_VLTextModel` with full attention in all layers.
        products: what matrix products and all between them are worked out in, where it is not the weights'
            type; sums over layers, and norms, stay in that.
        repeatable: a token's numbers do not depend on how many there are in a pass.
    """

    def __init__(
        self, text_model: Any, products: torch.dtype | None = None, *, repeatable: bool = False
    ) -> None:
        config = text_model.config
        if set(config.layer_types) != {"full_attention"}:
            raise ValueError("the torch engine runs decoders with full attention in every layer only")
        self._rotary = text_model.rotary_emb
        self.heads, self._groups = config.num_attention_heads, config.num_key_value_heads
        self._head_dim = config.hidden_size // config.num_attention_heads
        self._final_norm = text_model.norm.weight.detach()
        self._epsilon = self._final_norm.new_tensor(config.rms_norm_eps)
        self._products = products or self._final_norm.dtype
        self._layers = [
            _joined(layer, self._head_dim**-0.5, self._products, repeatable) for layer in text_model.layers
        ]

    def warm_up(self, sizes: Sequence[int]) -> None:
        """Multiply matrices of passes of so many tokens once: libraries keep the kernels that they make."""
        for product in self._layers[0]:
            for size in sizes:
                product(self._final_norm.new_zeros(size, product.width, dtype=self._products))

    def rotation(self, position_ids: Tensor) -> Rotation:
        """The rotary embedding of positions int64 [3, t]."""
        parts = self._rotary(self._final_norm, position_ids[:, None])
        cosines, sines = (part[0, :, None].to(self._products) for part in parts)
        half = self._head_dim // 2
        return Rotation(cosines, torch.cat([-sines[..., :half], sines[..., half:]], dim=-1))

    def __call__(
        self, embeddings: Tensor, rotation: Rotation, attention: Attention, wanted: Tensor | None
    ) -> Tensor:
        """Final hidden states [k, hidden] of some of the tokens [t, hidden].

        Args:
            wanted: int64 [k], the tokens whose states are asked for; None for none of them, when all that
                matters is the keys and values that ``attention`` stores.
        """
        x = embeddings
        turned, last = self.heads + self._groups, len(self._layers) - 1
        for index, layer in enumerate(self._layers):
            qkv = layer.qkv(self._scaled(x).to(self._products)).view(len(x), -1, self._head_dim)
            looking = rotation(qkv[:, :turned])
            query, key, value = looking[:, : self.heads], looking[:, self.heads :], qkv[:, turned:]
            attended = attention.attend(index, query, key, value)
            if index == last:
                # Nothing comes behind the last layer but the states that are wanted.
                if wanted is None:
                    return x[:0]
                x, attended = x.index_select(0, wanted), attended.index_select(0, wanted)
            x = x + layer.out(attended)
            gate, up = layer.gate_up(self._scaled(x).to(self._products)).chunk(2, dim=-1)
            x += layer.down(functional.silu(gate).mul_(up))
        return self._scaled(x).mul_(self._final_norm)

    def _scaled(self, x: Tensor) -> Tensor:
        """RMS norm without its weights, which are in the products behind it: half as many operations."""
        length = torch.linalg.vector_norm(x, dim=-1, keepdim=True)
        return x * torch.addcmul(self._epsilon, length, length, value=1 / x.shape[-1]).rsqrt_()


def _joined(layer: Any, query_scale: float, products: torch.dtype, repeatable: bool) -> _Layer:
    def product(weight: Tensor, bias: Tensor | None = None) -> _Product:
        return _Product(
            weight.to(products), None if bias is None else bias.to(products), repeatable=repeatable
        )

    attention, mlp = layer.self_attn, layer.mlp
    projections = (attention.q_proj, attention.k_proj, attention.v_proj)
    scales = (query_scale, 1.0, 1.0)
    weights = [part.weight.detach() * scale for part, scale in zip(projections, scales, strict=True)]
    biases = [part.bias.detach() * scale for part, scale in zip(projections, scales, strict=True)]
    norm_in, norm_mlp = layer.input_layernorm.weight.detach(), layer.post_attention_layernorm.weight.detach()
    gate_up = torch.cat([mlp.gate_proj.weight.detach(), mlp.up_proj.weight.detach()])
    return _Layer(
        qkv=product(torch.cat(weights) * norm_in, torch.cat(biases)),
        out=product(attention.o_proj.weight.detach()),
        gate_up=product(gate_up * norm_mlp),
        down=product(mlp.down_proj.weight.detach()),
    )
