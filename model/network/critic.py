"""Whether a trajectory holds: a critic inside the network, which checks it against what is known around.

To judge a trajectory is easier than to make one. A planner's state hardly tells where its trajectory meets
others. Where they are at each moment, if they go on as they do, tells it plainly. So the critic is given how
far each of them is from the ego's box over time, and how the ego lies on its route. It learns from
trajectories that were followed in the simulator.
"""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor, nn

from looktwice.model.driving.facts import (
    FACTS,
    LANE_WIDTH_M,
    LANES,
    RANKS,
    SPEED_SCALE_MS,
    WALKER_LEFT_SCALE_M,
    WALKER_SPEED_SCALE_MS,
    WALKERS,
)
from looktwice.model.driving.outcome import VERDICTS
from looktwice.model.driving.scene import EGO_LENGTH_M, EGO_WIDTH_M
from looktwice.model.driving.trajectory import FUTURE_STEPS, ROUTE_POINTS, STEP_S
from looktwice.model.network.motion import POSE_SCALE, present_speeds
from looktwice.model.network.route_line import RouteLine
from looktwice.model.network.track_features import (
    TRACK_FEATURES,
    TRACK_SPEED_SCALE_MS,
    X_SCALE_M,
    Y_SCALE_M,
)

OBJECT_FIELDS: Final = (
    *("present", "along_m", "left_m", "speed_along_ms", "speed_left_ms", "half_length_m", "half_width_m"),
    *("standing", "braking", "fixed", "walker"),
)
"""Of one of the others, along the route and to its left; ``present`` is a probability."""
_SCALES: Final = (1.0, 30.0, 3.0, 10.0, 2.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0)
_STEPS: Final = tuple(range(3, FUTURE_STEPS, 4))
"""Of a trajectory, at which the others are looked for: 0.4 s apart."""
_BRAKING_MS2: Final = 3.0
"""Of whoever brakes, until it stands."""
_CAR_HALF_LENGTH_M, _CAR_HALF_WIDTH_M = 2.3, 0.95
_OBSTACLE_HALF_LENGTH_M, _OBSTACLE_HALF_WIDTH_M = 0.5, 1.0
_WALKER_HALF_M: Final = 0.3
_LONGEST_LOG_M: Final = 4.5
_OUTLIER: Final = 6.0
_FARTHEST: Final = 4.0
"""Of scaled distances to the others: what is farther meets nobody."""
_NOBODY: Final = 4.0
_STANDING_MS: Final = 0.3
_PAST: Final = (0, 3, 6, 9, 12)
"""Poses of the history that are looked at."""
_WIDTH, _OBJECT_WIDTH = 192, 64


def objects_of_facts(facts: Tensor) -> Tensor:
    """Whom facts [b, len(FACTS)] tell of, [b, 11, fields]; with probabilities, see `fact_reader.likely`."""
    facts = facts.nan_to_num()
    nothing = torch.zeros(len(facts), device=facts.device)

    def told(name: str) -> Tensor:
        return facts[:, FACTS.index(name)]

    def metres(name: str) -> Tensor:
        return torch.expm1(told(name).clamp(0, _LONGEST_LOG_M))

    def one(*values: Tensor | float) -> Tensor:
        return torch.stack([nothing + value for value in values], dim=1)

    rows = []
    for lane, left_m in zip(LANES, (0.0, LANE_WIDTH_M, -LANE_WIDTH_M), strict=True):
        for name in (f"{lane}_{rank}" for rank in range(RANKS)):
            along = metres(f"{name}_gap_log_m") + _CAR_HALF_LENGTH_M + EGO_LENGTH_M / 2
            speed = SPEED_SCALE_MS * told(f"{name}_speed")
            box = along, left_m, speed, 0.0, _CAR_HALF_LENGTH_M, _CAR_HALF_WIDTH_M
            is_so = (told(f"{name}_{field}") for field in ("standing", "braking", "fixed"))
            rows.append(one(told(f"{name}_present"), *box, *is_so, 0.0))
        name = f"{lane}_obstacle"
        along = metres(f"{name}_gap_log_m") + _OBSTACLE_HALF_LENGTH_M + EGO_LENGTH_M / 2
        size = _OBSTACLE_HALF_LENGTH_M, _OBSTACLE_HALF_WIDTH_M
        rows.append(one(told(f"{name}_present"), along, left_m, 0.0, 0.0, *size, 1.0, 0.0, 1.0, 0.0))
    for name in (f"walker_{rank}" for rank in range(WALKERS)):
        left, speed = WALKER_LEFT_SCALE_M * told(f"{name}_left"), told(f"{name}_speed_left")
        place = metres(f"{name}_along_log_m"), left, 0.0, WALKER_SPEED_SCALE_MS * speed
        half = _WALKER_HALF_M, _WALKER_HALF_M
        rows.append(one(told(f"{name}_present"), *place, *half, 0.0, 0.0, 0.0, 1.0))
    return torch.stack(rows, dim=1)


def objects_of_tracks(tracks: Tensor, line: RouteLine) -> Tensor:
    """The others [b, 16, fields] of `track_features` [b, 16, features], along a line."""

    def told(name: str) -> Tensor:
        return tracks[..., TRACK_FEATURES.index(name)].float()

    cos, sin, speed = told("cos_heading"), told("sin_heading"), TRACK_SPEED_SCALE_MS * told("speed")
    xy_m = torch.stack([X_SCALE_M * told("x"), Y_SCALE_M * told("y")], dim=2)
    along, left, heading = line.places(xy_m)
    turn = torch.atan2(sin, cos) - heading
    standing = (speed.abs() < _STANDING_MS).to(speed.dtype)
    return torch.stack(
        [
            told("present"),
            along,
            left,
            speed * turn.cos(),
            speed * turn.sin(),
            2 * told("length"),
            told("width"),
            standing,
            told("brake"),
            torch.maximum(told("obstacle"), told("hazard")),
            told("pedestrian"),
        ],
        dim=2,
    )


class Critic(nn.Module):
    """Tells what comes of trajectories."""

    def __init__(self) -> None:
        super().__init__()
        steps = len(_STEPS)
        self.each = nn.Sequential(
            nn.Linear(len(OBJECT_FIELDS) + 4 * steps + 1, 2 * _OBJECT_WIDTH),
            nn.SiLU(),
            nn.Linear(2 * _OBJECT_WIDTH, _OBJECT_WIDTH),
            nn.SiLU(),
            nn.Linear(_OBJECT_WIDTH, _OBJECT_WIDTH),
        )
        self.way = nn.Sequential(nn.Linear(5 * steps + ROUTE_POINTS + 3 * len(_PAST), _WIDTH), nn.SiLU())
        layers: list[nn.Module] = []
        for width in (_WIDTH + 2 * _OBJECT_WIDTH, _WIDTH):
            layers += [nn.Linear(width, _WIDTH), nn.LayerNorm(_WIDTH), nn.SiLU(), nn.Dropout(0.0)]
        self.trunk = nn.Sequential(*layers, nn.Linear(_WIDTH, len(VERDICTS)))

    def forward(self, poses: Tensor, history: Tensor, line: RouteLine, objects: Tensor) -> Tensor:
        """Logits [b, k, `VERDICTS`] of trajectories.

        Args:
            poses: x, y and heading [b, k, 64, 3] of k trajectories in each scene.
            history: [b, 16, 4].
            line: of the routes.
            objects: [b, n, `OBJECT_FIELDS`].
        """
        scenes, each, steps = len(poses), poses.shape[1], list(_STEPS)
        times = STEP_S * (torch.tensor(steps, device=poses.device) + 1)
        now = present_speeds(history).float()[:, None, None]  # [b, 1, 1]
        along, left, heading = (
            part.view(scenes, each, len(steps)) for part in line.places(poses[:, :, steps, :2].flatten(1, 2))
        )
        rates = poses.diff(dim=2, prepend=torch.zeros_like(poses[:, :, :1])) / STEP_S
        speeds, turning = rates[..., :2].norm(dim=3), rates[..., 2]
        askew = torch.remainder(poses[:, :, steps, 2] - heading + torch.pi, 2 * torch.pi) - torch.pi
        bends = torch.atan2(line.units[..., 1], line.units[..., 0])[:, 1:-1]
        past = history[:, list(_PAST)][..., [0, 1, 3]].float() / history.new_tensor(POSE_SCALE).float()
        # What is the same for all trajectories of a scene.
        common = torch.cat([2 * bends, now[:, :, 0] / 10, past.flatten(1)], dim=1)
        parts = [left / 2, 3 * askew, speeds[:, :, steps] / 10, (turning * speeds)[:, :, steps] / 2]
        parts += [(along - now * times) / 20, common[:, None].expand(-1, each, -1)]
        # Geometry is worked out in single precision, whatever the weights are held in.
        dtype = next(self.trunk.parameters()).dtype
        way: Tensor = self.way(torch.cat(parts, dim=2).clamp(-_OUTLIER, _OUTLIER).to(dtype))  # [b, k, width]
        seen = self.each(_met(objects.float(), along, left, times, now).to(dtype))  # [b, k, n, width]
        there = objects[:, None, :, :1].float()
        most = (seen * there - _NOBODY * (1 - there)).amax(dim=2)
        logits: Tensor = self.trunk(torch.cat([way, most, (seen * there).sum(dim=2) / 4], dim=2).to(dtype))
        return logits.float()


def _met(objects: Tensor, along: Tensor, left: Tensor, times: Tensor, now: Tensor) -> Tensor:
    """How trajectories meet the others, if these go on as they do, or brake: [b, k, n, features].

    Args:
        objects: [b, n, fields].
        along, left: [b, k, t], of the trajectories.
        times: [t].
        now: the ego's speed, [b, 1, 1].
    """
    there = {name: objects[:, None, :, place, None] for place, name in enumerate(OBJECT_FIELDS)}
    speed = there["speed_along_ms"]  # [b, 1, n, 1]
    stops = torch.minimum(times, speed.clamp_min(0) / _BRAKING_MS2)
    braked = torch.where(speed > 0, speed * stops - _BRAKING_MS2 / 2 * stops.square(), speed * times)
    ahead = there["along_m"] + speed * times - along[:, :, None]  # [b, k, n, t]
    ahead_braked = there["along_m"] + braked - along[:, :, None]
    aside = there["left_m"] + there["speed_left_ms"] * times - left[:, :, None]
    beside = aside.abs() - there["half_width_m"] - EGO_WIDTH_M / 2
    length = there["half_length_m"] + EGO_LENGTH_M / 2
    rooms = [torch.maximum(each.abs() - length, beside) for each in (ahead, ahead_braked)]
    fields = (objects / objects.new_tensor(_SCALES))[:, None].expand(-1, along.shape[1], -1, -1)
    own = (now / 10)[..., None].expand(*fields.shape[:3], 1)
    met = [fields, rooms[0] / 3, rooms[1] / 3, ahead / 20, aside / 3, own]
    return torch.cat(met, dim=3).clamp(-_FARTHEST, _FARTHEST)
