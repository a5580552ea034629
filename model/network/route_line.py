"""Routes as curved axes, in batches: `looktwice.model.driving.route_frame` where the network needs it."""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
from torch import Tensor

from looktwice.model.driving.trajectory import ROUTE_POINTS, ROUTE_SPACING_M

_BEHIND_M: Final = 80.0
_BEYOND_M: Final = 80.0
_SHORTEST_M: Final = 1e-3


class RouteLine(NamedTuple):
    """A batch of routes that go straight on at both ends.

    Attributes:
        points: [b, p, 2] in the ego frame.
        units: [b, p - 1, 2], directions from a point to the next one.
        lengths, starts: [b, p - 1], of these segments in metres.
        here_m: [b, 1], where the ego stands along them.
    """

    points: Tensor
    units: Tensor
    lengths: Tensor
    starts: Tensor
    here_m: Tensor

    @classmethod
    def of(cls, route: Tensor, has_route: Tensor) -> RouteLine:
        """Of routes [b, 20, 2]; rows without one get the line straight ahead."""
        straight = route.new_zeros(ROUTE_POINTS, 2)
        straight[:, 0] = ROUTE_SPACING_M * torch.arange(1, ROUTE_POINTS + 1, device=route.device)
        route = torch.where(has_route[:, None, None], route.float(), straight.float())
        first, last = route[:, 1] - route[:, 0], route[:, -1] - route[:, -2]
        first = first / first.norm(dim=1, keepdim=True).clamp_min(_SHORTEST_M)
        last = last / last.norm(dim=1, keepdim=True).clamp_min(_SHORTEST_M)
        behind = route[:, :1] - (_BEHIND_M + ROUTE_SPACING_M) * first[:, None]
        points = torch.cat([behind, route, route[:, -1:] + _BEYOND_M * last[:, None]], dim=1)
        steps = points.diff(dim=1)
        lengths = steps.norm(dim=2).clamp_min(_SHORTEST_M)
        starts = lengths.cumsum(dim=1) - lengths
        line = cls(points, steps / lengths[..., None], lengths, starts, route.new_zeros(len(route), 1))
        return line._replace(here_m=line.places(route.new_zeros(len(route), 1, 2))[0])

    def places(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Metres along and to the left of points [b, k, 2], and the line's heading there: each [b, k]."""
        apart = points[:, :, None] - self.points[:, None, :-1]
        along = (apart * self.units[:, None]).sum(dim=3).clamp_min(0)
        along = torch.minimum(along, self.lengths[:, None])
        foot = apart - along[..., None] * self.units[:, None]
        segment = foot.square().sum(dim=3).argmin(dim=2, keepdim=True)
        row = torch.arange(len(points), device=points.device)[:, None]
        unit = self.units[row, segment[..., 0]]
        there = apart.gather(2, segment[..., None].expand(-1, -1, 1, 2))[:, :, 0]
        left = unit[..., 0] * there[..., 1] - unit[..., 1] * there[..., 0]
        along_m = self.starts[row, segment[..., 0]] + along.gather(2, segment)[..., 0] - self.here_m
        return along_m, left, torch.atan2(unit[..., 1], unit[..., 0])

    def poses(self, along_m: Tensor, left_m: Tensor) -> Tensor:
        """Points [b, k, 2] of the ego frame, so many metres along and to the left, each [b, k].

        The line turns smoothly from the middle of a segment to the middle of the next one.
        """
        ends = torch.cat([self.starts, self.starts[:, -1:] + self.lengths[:, -1:]], dim=1)
        wanted = along_m + self.here_m
        headings = torch.atan2(self.units[..., 1], self.units[..., 0])
        turned = headings.diff(dim=1, prepend=headings[:, :1])
        headings = headings[:, :1] + (torch.remainder(turned + torch.pi, 2 * torch.pi) - torch.pi).cumsum(1)
        heading = interpolated(wanted, self.starts + self.lengths / 2, headings[..., None])[..., 0]
        aside = torch.stack([-heading.sin(), heading.cos()], dim=2)
        return interpolated(wanted, ends, self.points) + left_m[..., None] * aside


def interpolated(wanted: Tensor, known: Tensor, values: Tensor) -> Tensor:
    """`numpy.interp` for a batch: values [b, p, c] known at ascending places [b, p], wanted at [b, k]."""
    right = torch.searchsorted(known.contiguous(), wanted.contiguous(), right=True)
    right = right.clamp(1, known.shape[1] - 1)
    row = torch.arange(len(known), device=known.device)[:, None]
    low, high = known[row, right - 1], known[row, right]
    share = ((wanted - low) / (high - low).clamp_min(1e-9)).clamp(0, 1)[..., None]
    return values[row, right - 1] + share * (values[row, right] - values[row, right - 1])
