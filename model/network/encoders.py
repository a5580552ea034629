"""The continuous tokens of an ego history and of a route."""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor, nn

from looktwice.model.driving.trajectory import HISTORY_STEPS, ROUTE_POINTS, ROUTE_SPACING_M, STEP_S

# Typical sizes, so that what the networks see is of order one: metres, metres, metres, radians.
_POSE_SCALE: Final = (10.0, 2.0, 1.0, 0.3)
_RATE_SCALE: Final = (10.0, 1.0, 1.0, 0.3)
"""Per second."""
_ROUTE_SCALE_M: Final = ROUTE_SPACING_M * ROUTE_POINTS / 2


class HistoryEncoder(nn.Module):
    """An MLP from an ego history [b, 16, 4] to one token [b, hidden].

    It sees the poses and their rates of change, each scaled to order one: speed and yaw rate, which
    matter most, are small differences of large numbers otherwise.
    """

    def __init__(self, hidden_size: int) -> None:
        super().__init__()
        self.layers = _mlp((2 * HISTORY_STEPS - 1) * 4, hidden_size)

    def forward(self, history: Tensor) -> Tensor:
        """One token [b, hidden] for each history [b, 16, 4]."""
        poses = history.float()
        rates = poses.diff(dim=1) / STEP_S
        features = torch.cat(
            [
                (poses / poses.new_tensor(_POSE_SCALE)).flatten(1),
                (rates / poses.new_tensor(_RATE_SCALE)).flatten(1),
            ],
            dim=1,
        )
        embedding: Tensor = self.layers(features.to(next(self.parameters()).dtype))
        return embedding


class RouteEncoder(nn.Module):
    """An MLP from a route [b, 20, 2] to one token [b, hidden]."""

    def __init__(self, hidden_size: int) -> None:
        super().__init__()
        self.layers = _mlp(ROUTE_POINTS * 2, hidden_size)

    def forward(self, route: Tensor) -> Tensor:
        """One token [b, hidden] for each route [b, 20, 2]."""
        features = (route.float() / _ROUTE_SCALE_M).flatten(1)
        embedding: Tensor = self.layers(features.to(next(self.parameters()).dtype))
        return embedding


def _mlp(inputs: int, hidden_size: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, hidden_size),
        nn.SiLU(),
        nn.Linear(hidden_size, hidden_size),
        nn.SiLU(),
        nn.Linear(hidden_size, hidden_size),
    )
