"""All cameras' vision tokens brought down to a few, which know where the ego goes.

A small decoder learns slowly what to look for among hundreds of vision tokens, and pays for each of them.
Here a few learned queries, moved by the ego's history and route, attend to all of them once; what they
gather stands in the prompt instead (a perceiver resampler, https://arxiv.org/abs/2204.14198, section 3.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from looktwice.model.driving.cameras import CAMERA_SPECS, CameraSpec
from looktwice.model.driving.facts import (
    FACT_GROUPS,
    FACTS,
    SPEED_SCALE_MS,
    WALKER_FIELDS,
    WALKER_SPEED_SCALE_MS,
)
from looktwice.model.driving.scene import CLIP_PERIOD_S
from looktwice.model.driving.trajectory import STEP_S
from looktwice.model.network.encoders import HistoryEncoder, RouteEncoder
from looktwice.model.network.fact_reader import FactReader, likely, weighed
from looktwice.model.network.fine_vision import TOLD, channels_of
from looktwice.model.network.intent import IntentReader, SketchCodes
from looktwice.model.network.route_line import RouteLine
from looktwice.model.network.second_sketch import Known

_HEADS: Final = 4
_LAYERS: Final = 2
_EPSILON: Final = 1e-6
_FARTHEST_LOG: Final = 5.0
_NEARER_LOG: Final = 2.0
_AHEAD_M: Final = 20.0
_BESIDE_M: Final = 3.0
_WIDE_M: Final = 30.0
"""Scales of where those are who are spotted, and how far to a side they are told."""
_FASTEST_MS: Final = 30.0
_ROUGH_MS: Final = 0.5
"""A speed that may be off by so much is told as half as fast."""
_OF_ROUTE: Final = ("along", "beside")
PICTURE_BEFORE: Final = -1 - round(CLIP_PERIOD_S / STEP_S)
"""The row of a history where the ego was when the picture before the latest was taken."""
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
            self.people_layers = nn.ModuleList(CrossLayer(hidden_size) for _ in range(_LAYERS))
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
            spotted = self.spotted(of_clips[:, :, of_tower:], history, route, has_route)
            # What the tower tells of people fits the scenes that it was learned in, and few others.
            people = alone[:, _PEOPLE:_ROAD]
            for layer in self.people_layers:
                people = layer(people, spotted)
            x = self.fine_layer(x, spotted)
            x = torch.cat([x[:, :_PEOPLE], people, x[:, _ROAD:]], dim=1)
        gathered: Tensor = self.norm(x)
        return gathered


class SpottedReader(nn.Module):
    """Whom convolutions spotted, told with where they are, and how they move.

    Args:
        hidden_size: of tokens.
        cameras: of a scene.
        fine_tokens: of each of them.
    """

    def __init__(self, hidden_size: int, cameras: Sequence[str], fine_tokens: int) -> None:
        super().__init__()
        self._specs = [CAMERA_SPECS[camera] for camera in cameras]
        self.places = nn.Parameter(0.02 * torch.randn(len(cameras), fine_tokens, hidden_size))
        self.told = nn.Linear(len(TOLD) + len(Spotted._fields) + len(_OF_ROUTE), hidden_size)
        self.seen = nn.Linear(channels_of(hidden_size), hidden_size)

    def forward(self, tokens: Tensor, history: Tensor, route: Tensor, has_route: Tensor) -> Tensor:
        """[b, cameras x n, hidden] of tokens [b, cameras, n, hidden] of `FineVision`.

        ``history`` [b, 16, 4], ``route`` [b, 20, 2] and ``has_route`` [b] as in `SceneResampler.gather`.
        """
        told, there = tokens[..., : len(TOLD)].float(), tokens[..., len(TOLD) :][..., : self.seen.in_features]
        ego_before = history[:, None, PICTURE_BEFORE].float()  # for all tokens of a camera
        of_cameras = [placed(spec, told[:, camera], ego_before) for camera, spec in enumerate(self._specs)]
        at = Spotted(*(torch.stack(parts, dim=1) for parts in zip(*of_cameras, strict=True)))
        places_m = torch.stack([at.ahead_m, at.left_m], dim=-1).flatten(1, 2)
        along_m, beside_m, _ = RouteLine.of(route, has_route).places(places_m)
        of_route = torch.stack([along_m / _AHEAD_M, beside_m.clamp(-_WIDE_M, _WIDE_M) / _BESIDE_M], dim=-1)
        of_route = (of_route * has_route[:, None, None]).view(*told.shape[:-1], len(_OF_ROUTE))
        numbers = torch.cat([told, at.scaled(), of_route], dim=-1) * told[..., :1]
        made: Tensor = self.told(numbers.to(there.dtype)) + self.seen(there) + self.places
        return made.flatten(1, 2)


class Spotted(NamedTuple):
    """Who is spotted, in the ego's frame, [..., n] each.

    Attributes:
        ahead_m, left_m: where they are.
        left_ms: how fast they cross, the less the less sure that is: a pixel is more metres farther away.
        ahead_ms: how fast they drive ahead, over the ground.
    """

    ahead_m: Tensor
    left_m: Tensor
    left_ms: Tensor
    ahead_ms: Tensor

    def scaled(self) -> Tensor:
        """All of it, of order one, [..., n, 4]."""
        left_m = self.left_m.clamp(-_WIDE_M, _WIDE_M)
        left_ms, ahead_ms = (each.clamp(-_FASTEST_MS, _FASTEST_MS) for each in (self.left_ms, self.ahead_ms))
        parts = (
            self.ahead_m / _AHEAD_M,
            left_m / _BESIDE_M,
            left_ms / WALKER_SPEED_SCALE_MS,
            ahead_ms / SPEED_SCALE_MS,
        )
        return torch.stack(parts, dim=-1)


def placed(spec: CameraSpec, told: Tensor, ego_before: Tensor) -> Spotted:
    """Where those are whom one camera tells of, and how they move.

    How fast they cross: from where they were in the picture before, and where they would have been had they
    not moved. How fast they drive: from how much nearer they came, and how far the ego drove.

    Args:
        spec: of the camera.
        told: [b, n, `TOLD`].
        ego_before: [b, 1, 4], where the ego was when the picture before was taken.
    """
    _, _, away_log, across, _, came, sure, nearer_log, *_ = told.unbind(-1)
    away_m = away_log.clamp(0, _FARTHEST_LOG).expm1()
    ahead_m, left_m = spec.from_above(spec.width / 2 * (1 + across), away_m)
    x_m, y_m, _, yaw = ego_before.unbind(-1)
    still_x_m = (ahead_m - x_m) * yaw.cos() + (left_m - y_m) * yaw.sin()
    still_y_m = (left_m - y_m) * yaw.cos() - (ahead_m - x_m) * yaw.sin()
    away_if_still_m, left_if_still_m = spec.depth_and_left(still_x_m, still_y_m)
    off_ms = away_m / spec.focal_px / CLIP_PERIOD_S  # by a pixel
    column_before = spec.width / 2 * (1 + across + came)
    left_before_m = spec.left_of(column_before, away_if_still_m)
    before_x_m, before_y_m = spec.from_above(
        column_before, away_m * nearer_log.clamp(-_NEARER_LOG, _NEARER_LOG).exp()
    )
    moved_ahead_m = ahead_m - x_m - before_x_m * yaw.cos() + before_y_m * yaw.sin()
    return Spotted(
        ahead_m,
        left_m,
        sure * (left_if_still_m - left_before_m) / CLIP_PERIOD_S / (1 + (off_ms / _ROUGH_MS) ** 2),
        moved_ahead_m / CLIP_PERIOD_S,
    )


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
