"""What else might be driven, in the prompt: the alternative to the sketch that is likeliest to hold.

A second look needs something that the first plan did not have. The critic checks the sketch and each of its
alternatives against what is known around. The best alternative stands in the prompt as the sketch does, so
that the decoder can copy it behind `Thinking:`. A token beside it tells how likely each of them holds.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
from torch import Tensor, nn

from looktwice.model.driving.outcome import VERDICTS
from looktwice.model.driving.trajectory import FUTURE_STEPS, STEP_S
from looktwice.model.network.alternatives import ALTERNATIVES, with_alternatives
from looktwice.model.network.codec import HEADING_WEIGHT_M
from looktwice.model.network.critic import Critic, objects_of_facts, objects_of_tracks
from looktwice.model.network.motion import present_speeds
from looktwice.model.network.route_line import RouteLine

VERDICT_TOKENS: Final = 1
LOOK_GAIN: Final = 0.3
"""A sketch deserves a second look where the second one is so much likelier to hold."""
_GAIN_WIDTH: Final = 0.05
_CERTAIN: Final = 6.0


class CurveSpace(NamedTuple):
    """The space of a checkpoint's codec, see `TrajectoryCodec`: ``mean`` [192] and ``axes`` [d, 192]."""

    mean: Tensor
    axes: Tensor

    def poses(self, vectors: Tensor, history: Tensor) -> Tensor:
        """x, y and heading [b, 64, 3] of vectors [b, d] behind histories [b, 16, 4]."""
        curves = (vectors.float() @ self.axes.float() + self.mean.float()).view(len(vectors), 3, FUTURE_STEPS)
        kept = _kept_speed(history)
        return torch.stack([curves[:, 0] + kept, curves[:, 1], curves[:, 2] / HEADING_WEIGHT_M], dim=2)

    def vectors(self, poses: Tensor, history: Tensor) -> Tensor:
        """The vectors [b, d] nearest to poses [b, 64, 3]: `poses` undone."""
        curves = torch.stack(
            [poses[..., 0] - _kept_speed(history), poses[..., 1], poses[..., 2] * HEADING_WEIGHT_M], dim=1
        )
        return (curves.flatten(1) - self.mean.float()) @ self.axes.float().T


class Known(NamedTuple):
    """What trajectories are judged by.

    Attributes:
        history: [b, 16, 4].
        route: [b, 20, 2]; rows without one are ignored.
        has_route: bool [b].
        facts: [b, len(FACTS)] with their probabilities, or None where tracks are known.
        tracks: [b, 16, features], or None where facts are known.
    """

    history: Tensor
    route: Tensor
    has_route: Tensor
    facts: Tensor | None = None
    tracks: Tensor | None = None


class SecondSketch(NamedTuple):
    """What else might be driven.

    Attributes:
        vectors: [b, d] of the best alternative, in the codec's space.
        verdicts: [b, 1 + alternatives, `VERDICTS`] log-probabilities, the sketch's first.
        places: int64 [b], of the best one in `ALTERNATIVES`.
    """

    vectors: Tensor
    verdicts: Tensor
    places: Tensor

    @property
    def gains(self) -> Tensor:
        """By how much the best alternative is likelier to hold than the sketch, [b]."""
        holds = self.verdicts[..., 0].exp()
        return holds[:, 1:].amax(dim=1) - holds[:, 0]


class SecondSketcher(nn.Module):
    """A critic, and what its verdicts become in the prompt.

    Args:
        hidden_size: of a token.
    """

    def __init__(self, hidden_size: int) -> None:
        super().__init__()
        self.critic = Critic()
        told = (1 + len(ALTERNATIVES)) * len(VERDICTS) + len(ALTERNATIVES)
        self.verdict = nn.Linear(told, hidden_size)
        # Without a mark, both sketches are the same kind of token. It is as long as a code's embedding, and
        # the same in all planners, as is what says that a look pays: what begins small is found late.
        self.mark, self.pays = _direction(1, hidden_size), _direction(2, hidden_size)

    def forward(self, sketch: Tensor, space: CurveSpace, known: Known) -> SecondSketch:
        """What else might be driven than sketches [b, d], vectors of the codec's space."""
        history = known.history
        # Metres and angles decide here: mixed precision would round them away.
        with torch.autocast(sketch.device.type, enabled=False):
            line = RouteLine.of(known.route, known.has_route)
            if known.tracks is not None:
                objects = objects_of_tracks(known.tracks, line)
            else:
                assert known.facts is not None, "the others are known by facts or by tracks"
                objects = objects_of_facts(known.facts)
            first = space.poses(sketch, history)
            poses = with_alternatives(first, history, line)
            verdicts = self.critic(poses, history, line, objects).log_softmax(dim=2)
            places = verdicts[:, 1:, 0].argmax(dim=1)
            best = poses[torch.arange(len(poses), device=poses.device), 1 + places]
            return SecondSketch(space.vectors(best, history), verdicts, places)

    def marked(self, tokens: Tensor) -> Tensor:
        """A sketch's tokens [b, stages, hidden] as those of the second one."""
        return tokens + self.mark.to(tokens.dtype)

    def token(self, found: SecondSketch) -> Tensor:
        """The verdict as a token [b, 1, hidden]."""
        which = nn.functional.one_hot(found.places, len(ALTERNATIVES)).to(found.verdicts.dtype)
        verdicts = found.verdicts.clamp_min(-_CERTAIN).flatten(1) / 3
        token: Tensor = self.verdict(torch.cat([verdicts, which], dim=1).to(self.verdict.weight.dtype))
        return token[:, None]

    def doubt(self, found: SecondSketch) -> Tensor:
        """Whether a second look pays, [b, 1, hidden], to be added to the tokens of the planner's state.

        Behind each plan the decoder looks at these anyway, and so reads it at once; in a token of its own, a
        thousand steps did not teach it to look there.
        """
        pays = torch.tanh((found.gains - LOOK_GAIN) / _GAIN_WIDTH)
        return (pays[:, None].to(self.pays.dtype) * self.pays)[:, None]


def _direction(number: int, size: int) -> nn.Parameter:
    """A direction [size] of length 1, the same on every device; two numbers' have little in common."""
    chirp = torch.sin(number * torch.arange(size, dtype=torch.float32).square())
    return nn.Parameter(nn.functional.normalize(chirp, dim=0))


def _kept_speed(history: Tensor) -> Tensor:
    """How far whoever keeps its speed has come, [b, 64]."""
    times = STEP_S * torch.arange(1, FUTURE_STEPS + 1, device=history.device)
    return present_speeds(history).float()[:, None] * times
