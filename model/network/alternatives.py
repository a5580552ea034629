"""Other trajectories than the one that was sketched: at another pace on its way, or at its pace on the route.

They are the mends of `looktwice.model.driving.mends` that need no expert, for a batch at once and where the
network can reach them.
"""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor

from looktwice.model.driving.mends import BRAKE_MS2, FASTER_MS2, SLOWER_SHARE, SLOWING_S, Alternative, Mend
from looktwice.model.driving.trajectory import FUTURE_STEPS, MAX_POSITION_M, STEP_S
from looktwice.model.network.motion import present_speeds
from looktwice.model.network.route_line import RouteLine, interpolated

PACES: Final[tuple[Mend, ...]] = (*SLOWER_SHARE, *BRAKE_MS2, *FASTER_MS2)
ALTERNATIVES: Final[tuple[Alternative, ...]] = (*PACES, "the route's way")
_BACK_S: Final = 2.0
_SHORTEST_BACK_M: Final = 10.0
_STEEPEST_RAD: Final = 0.5


def alternatives(poses: Tensor, history: Tensor, line: RouteLine) -> Tensor:
    """x, y and heading [b, `ALTERNATIVES`, 64, 3] of what else might be driven than poses [b, 64, 3].

    Args:
        poses: of trajectories.
        history: [b, 16, 4].
        line: of their routes.
    """
    times = STEP_S * torch.arange(1, FUTURE_STEPS + 1, device=poses.device)
    pace = _speeds(poses)
    paces = [pace * (1 - share * (times / SLOWING_S).clamp_max(1)) for share in SLOWER_SHARE.values()]
    for rate in BRAKE_MS2.values():
        braked = present_speeds(history).float()[:, None] - rate * times
        paces.append(torch.minimum(pace, braked.clamp_min(0)))
    paces += [pace + rate * times for rate in FASTER_MS2.values()]
    slower = _paced(poses, torch.stack(paces, dim=1))
    return torch.cat([slower, _paced(_along_route(poses, pace, history, line), pace[:, None])], dim=1)


def with_alternatives(poses: Tensor, history: Tensor, line: RouteLine) -> Tensor:
    """Trajectories [b, 64, 3] with their `alternatives` behind them, [b, 1 + `ALTERNATIVES`, 64, 3]."""
    return torch.cat([poses[:, None], alternatives(poses, history, line)], dim=1)


def _speeds(poses: Tensor) -> Tensor:
    """Signed speeds [b, 64]; see `looktwice.model.driving.trajectory.speeds`."""
    step = poses[..., :2].diff(dim=1, prepend=torch.zeros_like(poses[:, :1, :2]))
    along = step[..., 0] * poses[..., 2].cos() + step[..., 1] * poses[..., 2].sin()
    signed: Tensor = step.norm(dim=2).copysign(along) / STEP_S
    return signed


def _paced(path: Tensor, speeds: Tensor) -> Tensor:
    """The way of paths [b, 64, 3] with speeds [b, k, 64]: [b, k, 64, 3]; `trajectory.paced` in batches."""
    scenes = len(path)
    begin = path.new_zeros(scenes, 1, 3)
    poses = torch.cat([begin, path], dim=1)
    driven = (_speeds(path) * STEP_S).cumsum(dim=1)
    along = torch.cat([driven.new_zeros(scenes, 1), driven], dim=1).cummax(dim=1).values
    heading = poses[:, -1, 2]
    ahead = MAX_POSITION_M * torch.stack([heading.cos(), heading.sin(), torch.zeros_like(heading)], dim=1)
    behind = begin - MAX_POSITION_M * path.new_tensor([1.0, 0.0, 0.0])
    way = torch.cat([behind, poses, poses[:, -1:] + ahead[:, None]], dim=1)
    way_m = torch.cat([along[:, :1] - MAX_POSITION_M, along, along[:, -1:] + MAX_POSITION_M], dim=1)
    wanted = (speeds * STEP_S).cumsum(dim=2).flatten(1)
    return interpolated(wanted, way_m, way).view(scenes, speeds.shape[1], FUTURE_STEPS, 3)


def _along_route(poses: Tensor, pace: Tensor, history: Tensor, line: RouteLine) -> Tensor:
    """Ways [b, 64, 3] from where the ego is and looks to the middle of its route, farther than it drives.

    A cubic leads back: it begins with the ego's own slope and ends flat, within two seconds of its way.
    """
    scenes = len(poses)
    _, left, heading = (part[:, :1] for part in line.places(poses.new_zeros(scenes, 1, 2)))  # [b, 1]
    slope = torch.tan((-heading).clamp(-_STEEPEST_RAD, _STEEPEST_RAD))
    back = (_BACK_S * present_speeds(history).float()[:, None]).clamp_min(_SHORTEST_BACK_M)
    farthest = (1.2 * STEP_S * pace.abs().sum(dim=1, keepdim=True) + 5).clamp_min(30)
    along = farthest / FUTURE_STEPS * torch.arange(1, FUTURE_STEPS + 1, device=poses.device)
    u = (along / back).clamp_max(1)
    aside = left * (2 * u**3 - 3 * u**2 + 1) + slope * back * (u**3 - 2 * u**2 + u)
    points = line.poses(along, aside)
    step = points.diff(dim=1, prepend=points.new_zeros(scenes, 1, 2))
    return torch.cat([points, torch.atan2(step[..., 1], step[..., 0])[..., None]], dim=2)
