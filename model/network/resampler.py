"""All cameras' vision tokens brought down to a few, which know where the ego goes.

A small decoder learns slowly what to look for among hundreds of vision tokens, and pays for each of them.
Here a few learned queries, moved by the ego's history and route, attend to all of them once; what they
gather stands in the prompt instead (a perceiver resampler, https://arxiv.org/abs/2204.14198, section 3.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from looktwice.model.driving.cameras import CAMERA_SPECS
from looktwice.model.driving.facts import FACT_GROUPS, FACTS, WALKER_FIELDS
from looktwice.model.network.encoders import HistoryEncoder, RouteEncoder
from looktwice.model.network.fact_reader import FactReader, likely, weighed
from looktwice.model.network.fine_vision import TOLD, channels_of
from looktwice.model.network.intent import IntentReader, SketchCodes
from looktwice.model.network.second_sketch import Known

_HEADS: Final = 4
_LAYERS: Final = 2
_EPSILON: Final = 1e-6
_FARTHEST_LOG: Final = 5.0
_AHEAD_M: Final = 20.0
_BESIDE_M: Final = 3.0
_WIDE_M: Final = 30.0
"""Scales of where those are who are spotted, and how far to a side they are told."""
_PEOPLE: Final = FACT_GROUPS.index(WALKER_FIELDS)
"""The first query of those who walk; the last one is before that of the `_ROAD`."""
_ROAD: Final = len(FACT_GROUPS) - 1


class SceneResampler(nn.Module):
    """Learned queries over the vision tokens of a scene.

    Args:
        hidden_size: of vision tokens and of what comes out.
        vision_tokens: of the tower in a scene, all cameras together.
        cameras: of a scene, a clip of each.
        fine_tokens: of each clip, of the convolutions beside the tower.
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
        cameras: Sequence[str] = (),
        fine_tokens: int = 0,
        sketches: bool = False,
        second: bool = False,
    ) -> None:
        super().__init__()
        self.queries = nn.Parameter(0.3 * torch.randn(queries, hidden_size))
        self._cameras, self._fine_tokens = max(len(cameras), 1), fine_tokens
        self.places = nn.Parameter(0.02 * torch.randn(vision_tokens, hidden_size))
        self.history_encoder = HistoryEncoder(hidden_size)
        self.route_encoder = RouteEncoder(hidden_size)
        self.no_route = nn.Parameter(torch.zeros(hidden_size))
        self.vision_norm = nn.RMSNorm(hidden_size, eps=_EPSILON)
        self.layers = nn.ModuleList(CrossLayer(hidden_size) for _ in range(_LAYERS))
        if fine_tokens:
            self.spotted = SpottedReader(hidden_size, cameras, fine_tokens)
            self.fine_layer = CrossLayer(hidden_size)
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
            vision_tokens: [b, v, hidden], of each clip those of the tower, then those of convolutions.
            history: [b, 16, 4].
            route: [b, 20, 2]; rows without one are ignored.
            has_route: bool [b].
        """
        way = torch.where(has_route[:, None], self.route_encoder(route), self.no_route)
        moved = self.history_encoder(history) + way
        x = self.queries + moved[:, None]
        alone = x
        of_clips = vision_tokens.to(x.dtype).view(len(vision_tokens), self._cameras, -1, x.shape[-1])
        of_tower = of_clips.shape[2] - self._fine_tokens
        seen = self.vision_norm(of_clips[:, :, :of_tower].flatten(1, 2)) + self.places
        for layer in self.layers:
            x = layer(x, seen)
        if self._fine_tokens:
            # What the tower tells of people fits the scenes that it was learned in, and few others.
            x = torch.cat([x[:, :_PEOPLE], alone[:, _PEOPLE:_ROAD], x[:, _ROAD:]], dim=1)
            x = self.fine_layer(x, self.spotted(of_clips[:, :, of_tower:]))
        gathered: Tensor = self.norm(x)
        return gathered


class SpottedReader(nn.Module):
    """Whom convolutions spotted, told with where they are in the ego's frame.

    Args:
        hidden_size: of tokens.
        cameras: of a scene.
        fine_tokens: of each of them.
    """

    def __init__(self, hidden_size: int, cameras: Sequence[str], fine_tokens: int) -> None:
        super().__init__()
        self._specs = [CAMERA_SPECS[camera] for camera in cameras]
        self.places = nn.Parameter(0.02 * torch.randn(len(cameras), fine_tokens, hidden_size))
        self.told = nn.Linear(len(TOLD) + 2, hidden_size)
        self.seen = nn.Linear(channels_of(hidden_size), hidden_size)

    def forward(self, tokens: Tensor) -> Tensor:
        """[b, cameras x n, hidden] of tokens [b, cameras, n, hidden] of `FineVision`."""
        told, there = tokens[..., : len(TOLD)], tokens[..., len(TOLD) :][..., : self.seen.in_features]
        likely, _, away_log, across, _ = told.unbind(-1)
        away_m = away_log.clamp(0, _FARTHEST_LOG).expm1()
        places = [
            spec.from_above(spec.width / 2 * (1 + across[:, camera]), away_m[:, camera])
            for camera, spec in enumerate(self._specs)
        ]
        ahead_m, left_m = (torch.stack(part, dim=1) for part in zip(*places, strict=True))
        at = torch.stack([ahead_m / _AHEAD_M, left_m.clamp(-_WIDE_M, _WIDE_M) / _BESIDE_M], dim=-1)
        numbers = torch.cat([told, at], dim=-1) * likely[..., None]
        made: Tensor = self.told(numbers) + self.seen(there) + self.places
        return made.flatten(1, 2)


class _SceneIntent(IntentReader):
    """What to do about the facts that are read."""

    def state(self, facts: Tensor, history: Tensor, route: Tensor, has_route: Tensor) -> Tensor:
        """What to do, [b, 256], about facts [b, len(FACTS)] with their probabilities; see `likely`."""
        state: Tensor = self.trunk(history, route, has_route, weighed(facts))
        return state


class CrossLayer(nn.Module):
    """Queries attend to what is seen, and each is worked over by itself."""

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

    @torch.no_grad()
    def hush(self) -> None:
        """Leave queries as they are: nothing is added before something is learned."""
        for last in (self.out, self.mlp[-1]):
            assert isinstance(last, nn.Linear)
            last.weight.zero_()
            last.bias.zero_()

    def forward(self, x: Tensor, seen: Tensor) -> Tensor:
        """Queries [b, q, hidden] that have looked at ``seen`` [b, v, hidden]."""
        rows, queries, width = x.shape
        query = self.query(self.query_norm(x)).view(rows, queries, _HEADS, -1).transpose(1, 2)
        key, value = self.key_value(seen).view(rows, -1, 2, _HEADS, width // _HEADS).permute(2, 0, 3, 1, 4)
        # A plain product: with so few queries it is faster than a fused kernel, and trains on CPUs.
        scores = query @ key.transpose(-1, -2) * (width // _HEADS) ** -0.5
        attended = F.softmax(scores, dim=-1) @ value
        x = x + self.out(attended.transpose(1, 2).reshape(rows, queries, width))
        return x + self.mlp(self.mlp_norm(x))  # type: ignore[no-any-return]
