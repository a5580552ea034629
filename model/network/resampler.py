"""All cameras' vision tokens brought down to a few, which know where the ego goes.

A small decoder learns slowly what to look for among hundreds of vision tokens, and pays for each of them.
Here a few learned queries, moved by the ego's history and route, attend to all of them once; what they
gather stands in the prompt instead (a perceiver resampler, https://arxiv.org/abs/2204.14198, section 3.1).
"""

from __future__ import annotations

from typing import Final

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from looktwice.model.driving.facts import FACTS
from looktwice.model.network.encoders import HistoryEncoder, RouteEncoder
from looktwice.model.network.fact_reader import FactReader, likely, weighed
from looktwice.model.network.intent import IntentReader, SketchCodes
from looktwice.model.network.second_sketch import Known

_HEADS: Final = 4
_LAYERS: Final = 2
_EPSILON: Final = 1e-6


class SceneResampler(nn.Module):
    """Learned queries over the vision tokens of a scene.

    Args:
        hidden_size: of vision tokens and of what comes out.
        vision_tokens: of a scene, all cameras together.
        queries: how many. A token comes out for each, and those that say what to do about it.
        sketches: whether a sketch is among them.
        second: and what else might be driven.
    """

    def __init__(
        self,
        hidden_size: int,
        vision_tokens: int,
        queries: int,
        *,
        sketches: bool = False,
        second: bool = False,
    ) -> None:
        super().__init__()
        self.queries = nn.Parameter(0.3 * torch.randn(queries, hidden_size))
        self.places = nn.Parameter(0.02 * torch.randn(vision_tokens, hidden_size))
        self.history_encoder = HistoryEncoder(hidden_size)
        self.route_encoder = RouteEncoder(hidden_size)
        self.no_route = nn.Parameter(torch.zeros(hidden_size))
        self.vision_norm = nn.RMSNorm(hidden_size, eps=_EPSILON)
        self.layers = nn.ModuleList(_CrossLayer(hidden_size) for _ in range(_LAYERS))
        self.norm = nn.RMSNorm(hidden_size, eps=_EPSILON)
        self.facts = FactReader(hidden_size)
        self.intent = _SceneIntent(hidden_size, len(FACTS), sketches=sketches, second=second)

    def forward(
        self,
        vision_tokens: Tensor,
        history: Tensor,
        route: Tensor,
        has_route: Tensor,
        codes: SketchCodes | None = None,
    ) -> Tensor:
        """What stands in the prompt, [b, scene_tokens, hidden]; see `gather` and `IntentReader.written`."""
        gathered = self.gather(vision_tokens, history, route, has_route)
        facts = likely(self.facts(gathered))
        state = self.intent.state(facts, history, route, has_route)
        known = Known(history, route, has_route, facts=facts)
        return torch.cat([gathered, self.intent.written(state, codes, known)], dim=1)

    def gather(self, vision_tokens: Tensor, history: Tensor, route: Tensor, has_route: Tensor) -> Tensor:
        """What the queries gather, [b, queries, hidden].

        Args:
            vision_tokens: [b, vision_tokens, hidden].
            history: [b, 16, 4].
            route: [b, 20, 2]; rows without one are ignored.
            has_route: bool [b].
        """
        way = torch.where(has_route[:, None], self.route_encoder(route), self.no_route)
        moved = self.history_encoder(history) + way
        x = self.queries + moved[:, None]
        seen = self.vision_norm(vision_tokens.to(x.dtype)) + self.places
        for layer in self.layers:
            x = layer(x, seen)
        gathered: Tensor = self.norm(x)
        return gathered


class _SceneIntent(IntentReader):
    """What to do about the facts that are read."""

    def state(self, facts: Tensor, history: Tensor, route: Tensor, has_route: Tensor) -> Tensor:
        """What to do, [b, 256], about facts [b, len(FACTS)] with their probabilities; see `likely`."""
        state: Tensor = self.trunk(history, route, has_route, weighed(facts))
        return state


class _CrossLayer(nn.Module):
    def __init__(self, hidden_size: int) -> None:
        super().__init__()
        self.query_norm = nn.RMSNorm(hidden_size, eps=_EPSILON)
        self.query = nn.Linear(hidden_size, hidden_size)
        self.key_value = nn.Linear(hidden_size, 2 * hidden_size)
        self.out = nn.Linear(hidden_size, hidden_size)
        self.mlp_norm = nn.RMSNorm(hidden_size, eps=_EPSILON)
        self.mlp = nn.Sequential(
            nn.Linear(hidden_size, 3 * hidden_size), nn.SiLU(), nn.Linear(3 * hidden_size, hidden_size)
        )

    def forward(self, x: Tensor, seen: Tensor) -> Tensor:
        rows, queries, width = x.shape
        query = self.query(self.query_norm(x)).view(rows, queries, _HEADS, -1).transpose(1, 2)
        key, value = self.key_value(seen).view(rows, -1, 2, _HEADS, width // _HEADS).permute(2, 0, 3, 1, 4)
        # A plain product: with so few queries it is faster than a fused kernel, and trains on CPUs.
        scores = query @ key.transpose(-1, -2) * (width // _HEADS) ** -0.5
        attended = F.softmax(scores, dim=-1) @ value
        x = x + self.out(attended.transpose(1, 2).reshape(rows, queries, width))
        return x + self.mlp(self.mlp_norm(x))  # type: ignore[no-any-return]
