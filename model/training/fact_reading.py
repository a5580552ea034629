"""Learning to read facts from what a frozen tower sees: forty times as fast as with the tower.

Who learned from an expert's pictures alone has not seen a broken-down car close ahead, or a gap of a metre:
experts never come so near. A planner does that misreads them. What its pictures show stands in the tower's
tokens all the same, so the resampler learns to read it from there, over tokens that are worked out once.

Who knows the car's own past reads it, too. Experts are slow on an open road where somebody crosses it, so
whoever is slow reads a walker there, stays slow, and reads it again (causal confusion,
https://arxiv.org/abs/1905.11979). So one half of the scenes come with the past of another one. There only
what does not depend on the own speed is taught.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from torch import Tensor, nn
from torch.utils.data import Dataset

from looktwice.model.driving.facts import NEEDS_OWN_SPEED, mirrored
from looktwice.model.network.vla import LookTwiceVla
from looktwice.model.training.batches import mean_values
from looktwice.model.training.examples import Examples
from looktwice.model.training.grounding import fact_loss, fact_weights
from looktwice.model.training.vision_cache import VisionCache

OTHER_PAST_SHARE: Final = 0.5
"""Of scenes with the past of another one."""


class FactSample(NamedTuple):
    """One scene: ``tokens`` [v, hidden] of its pictures; other shapes as in `Examples`, for one example."""

    tokens: npt.NDArray[np.float32]
    history: npt.NDArray[np.float32]
    route: npt.NDArray[np.float32]
    has_route: npt.NDArray[np.bool_]
    facts: npt.NDArray[np.float32]


class FactLook(NamedTuple):
    """How an example is looked at: its mirror image, with its route, and with whose past."""

    place: int
    mirror: bool
    route: bool
    past: int


class FactDataset(Dataset[FactSample]):
    """All examples, each time mirrored or not, with or without its route, with its past or not, by chance.

    Args:
        examples: to learn from; those without pictures must not be asked for.
        vision: what the tower sees in them.
        route_share: share that is given its route.
        seed: of what is left to chance.
    """

    def __init__(self, examples: Examples, vision: VisionCache, route_share: float, seed: int = 0) -> None:
        self._examples, self._vision, self._route_share = examples, vision, route_share
        self.random = np.random.default_rng(seed)

    def __len__(self) -> int:
        return len(self._examples)

    def __getitem__(self, index: int) -> FactSample:
        return self.taken(self.chance(index))

    def chance(self, index: int) -> FactLook:
        """How to look at an example this time."""
        chance = self.random.random(3)
        mirror = self._vision.mirrored and bool(chance[0] < 0.5)
        past = int(self.random.integers(len(self))) if chance[2] < OTHER_PAST_SHARE else index
        return FactLook(index, mirror, bool(chance[1] < self._route_share), past)

    def taken(self, look: FactLook) -> FactSample:
        """One example, looked at so."""
        sample = self.look(look.place, mirror=look.mirror, route=look.route)
        if look.past == look.place:
            return sample
        facts = np.where(NEEDS_OWN_SPEED, np.float32(np.nan), sample.facts)
        return sample._replace(history=self._examples.history[look.past], facts=facts)

    def look(self, index: int, *, mirror: bool, route: bool) -> FactSample:
        """One example as it is asked for."""
        history, way, known = self._examples.motion(index, mirror=mirror, route=route)
        facts = self._examples.facts[index]
        tokens = self._vision.tokens(index, mirror).astype(np.float32)
        return FactSample(tokens, history, way, np.array(known), mirrored(facts) if mirror else facts)


class FactLearner(nn.Module):
    """The resampler without its small planner; outputs the loss of what it reads.

    Args:
        vla: its resampler is trained in place.

    Raises:
        ValueError: the checkpoint has no resampler.
    """

    def __init__(self, vla: LookTwiceVla) -> None:
        super().__init__()
        if vla.resampler is None:
            raise ValueError("reading facts needs a checkpoint with a resampler (scene_tokens > 0)")
        # By another name than in the network, where it learns at the tower's rate: none, here.
        self.reader = vla.resampler
        self.reader.intent.requires_grad_(False)
        self.register_buffer("fact_weights", fact_weights(fine=vla.fine_vision is not None))

    fact_weights: Tensor

    def forward(
        self, tokens: Tensor, history: Tensor, route: Tensor, has_route: Tensor, facts: Tensor
    ) -> dict[str, Tensor]:
        """The loss of a batch of `FactSample`."""
        read = self.reader.facts(self.reader.gather(tokens, history, route, has_route))
        return {"loss": fact_loss(read, facts, self.fact_weights)}


def reading_errors(learner: FactLearner, examples: Examples, vision: VisionCache) -> Mapping[str, float]:
    """``fact_loss/read`` of held-out scenes with pictures, without and with their route.

    The learner is put into evaluation mode meanwhile.
    """
    data, places = FactDataset(examples, vision, route_share=1.0), np.flatnonzero(examples.pictured).tolist()
    figures: dict[str, float] = {}
    for suffix, route in (("", False), ("+route", True)):
        means = mean_values(learner, partial(data.look, mirror=False, route=route), places)
        figures |= {f"fact_{name}/read{suffix}": mean for name, mean in means.items()}
    return figures
