"""An ego's motion as numbers for networks: its history, its speed, and the route before it."""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor

from looktwice.model.driving.trajectory import HISTORY_STEPS, ROUTE_POINTS, ROUTE_SPACING_M, STEP_S

POSE_SCALE: Final = (10.0, 2.0, 0.3)
"""Of x, y and heading: numbers of order one come out."""
_OUTLIER: Final = 6.0
MOTION_FEATURES: Final = 3 * (2 * HISTORY_STEPS - 1) + 2 * 2 * ROUTE_POINTS + 1


def motion_features(history: Tensor, route: Tensor, has_route: Tensor) -> Tensor:
    """History and route as numbers of order one, [b, MOTION_FEATURES].

    Args:
        history: [b, 16, 4].
        route: [b, 20, 2]; rows without one are ignored.
        has_route: bool [b].
    """
    poses = history[..., [0, 1, 3]].float()
    scale = poses.new_tensor(POSE_SCALE)
    straight = ROUTE_SPACING_M * torch.arange(1, ROUTE_POINTS + 1, device=poses.device)
    aside = route.float() - torch.stack([straight, torch.zeros_like(straight)], dim=1)
    known = has_route[:, None].float()
    parts = [(poses / scale).flatten(1), (poses.diff(dim=1) / STEP_S / scale).flatten(1)]
    parts += [(route.float() / 40).flatten(1) * known, (aside / 4).flatten(1) * known, known]
    return torch.cat(parts, dim=1).clamp(-_OUTLIER, _OUTLIER)


def present_speeds(history: Tensor) -> Tensor:
    """Metres a second [b] at the end of histories [b, 16, 4]."""
    return -history[:, -4, 0] / (3 * STEP_S)
