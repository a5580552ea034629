"""Trajectories by regression: one best guess and a few modes with scores, in the codec's space."""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from looktwice.model.driving.trajectory import FUTURE_STEPS, STEP_S
from looktwice.model.network.codec import HEADING_WEIGHT_M, TrajectoryCodec

MODES: Final = 6
_HEADING_WEIGHT: Final = 1.5
"""Metres that a radian of mean error in heading counts in the loss."""
_ALL_MODES_WEIGHT: Final = 0.03
"""Of the modes that are not the nearest: enough to keep them on the road."""
_NEAR_STEPS: Final = 15
_NEAR_WEIGHT: Final = 5.0
"""How much more a step of the first 1.5 s counts than a later one: the next plan comes before those."""


class Guesses(NamedTuple):
    """What a head tells, in the codec's space.

    Attributes:
        best: [b, d].
        modes: [b, modes, d].
        scores: [b, modes], logits.
    """

    best: Tensor
    modes: Tensor
    scores: Tensor


def spread_of(book: Tensor) -> Tensor:
    """How far trajectories lie apart along each axis [d]: the first codebook [K, d] spreads as they do."""
    return book.std(dim=0, correction=0) + 0.01


class TrajectoryHead(nn.Module):
    """Linear maps from a state to trajectories.

    Args:
        width: of the states.
        codec: whose space is used: the curves are smooth and begin where the ego is.
        best: makes the best guess in place of a layer of the head's own.
    """

    axes: Tensor
    mean: Tensor
    spread: Tensor

    def __init__(self, width: int, codec: TrajectoryCodec, best: nn.Linear | None = None) -> None:
        super().__init__()
        axes = torch.from_numpy(codec.axes.copy())
        self.register_buffer("axes", axes)
        self.register_buffer("mean", torch.from_numpy(codec.mean.copy()))
        self.register_buffer("spread", spread_of(torch.from_numpy(codec.books[0])))
        self.best = best or nn.Linear(width, len(axes))
        self.modes = nn.Linear(width, MODES * len(axes))
        self.scores = nn.Linear(width, MODES)
        # Begin at the mean trajectory, modes around it: a head at random would bend the network to its whims.
        for layer in (self.modes, self.scores) if best else (self.best, self.modes, self.scores):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        nn.init.normal_(self.modes.bias)

    def forward(self, states: Tensor) -> Guesses:
        """Guesses for states [b, width]."""
        modes = self.modes(states).view(len(states), MODES, -1)
        return Guesses(self.best(states) * self.spread, modes * self.spread, self.scores(states))

    def curves(self, vectors: Tensor, speeds_ms: Tensor) -> Tensor:
        """x, y and heading [..., 64, 3] of vectors [..., d], for present speeds [...] or [b]."""
        flat = vectors.float() @ self.axes + self.mean
        curves = flat.view(*flat.shape[:-1], 3, FUTURE_STEPS)
        times = STEP_S * torch.arange(1, FUTURE_STEPS + 1, device=vectors.device)
        speeds = speeds_ms.reshape(speeds_ms.shape + (1,) * (curves.dim() - 1 - speeds_ms.dim()))
        return torch.stack(
            [curves[..., 0, :] + speeds * times, curves[..., 1, :], curves[..., 2, :] / HEADING_WEIGHT_M],
            dim=-1,
        )

    def loss(self, guesses: Guesses, speeds_ms: Tensor, futures: Tensor) -> dict[str, Tensor]:
        """The loss of guesses against futures [b, 64, 4], and the best guess's ADE in metres.

        The best guess is drawn to the expert's trajectory in metres; of the modes only the nearest one is.
        The first 1.5 s count more.
        """
        poses = futures[..., [0, 1, 3]]
        weights = _near_weights(poses)
        best_m, best_rad = _apart(self.curves(guesses.best, speeds_ms), poses)
        modes_m, modes_rad = _apart(self.curves(guesses.modes, speeds_ms), poses[:, None])
        best = ((best_m + _HEADING_WEIGHT * best_rad) * weights).mean(dim=-1)
        modes = (modes_m * weights).mean(dim=-1)
        nearest = modes.detach().argmin(dim=1)
        rows = torch.arange(len(nearest), device=nearest.device)
        nearest_loss = modes[rows, nearest] + _HEADING_WEIGHT * (modes_rad[rows, nearest] * weights).mean(
            dim=-1
        )
        others = _ALL_MODES_WEIGHT * modes.mean(dim=1)
        scored = F.cross_entropy(guesses.scores.float(), nearest)
        loss = (best + nearest_loss + others).mean() + scored
        return {"loss": loss, "ade_m": best_m.detach().mean()}


def _near_weights(poses: Tensor) -> Tensor:
    """What each step of a trajectory counts [64]: one on average."""
    weights = torch.ones(poses.shape[-2], device=poses.device)
    weights[:_NEAR_STEPS] = _NEAR_WEIGHT
    return weights / weights.mean()


def _apart(curves: Tensor, poses: Tensor) -> tuple[Tensor, Tensor]:
    """Distance in metres and difference of heading in radians, at each step [..., 64]."""
    return (curves[..., :2] - poses[..., :2]).norm(dim=-1), (curves[..., 2] - poses[..., 2]).abs()
