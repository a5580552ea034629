"""Learning what to do about what is known, thousands of scenes a second: before a decoder puts it into words.

The reader of tracks and the intent of the gathered tokens (`looktwice.model.network.intent`) learn the
expert's trajectory in metres, its plan's words bin by bin, and the facts that decide them. The best guess of
the trajectory is kept as the sketch; all other heads are thrown away. Tower and queries stay as they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.data import Dataset

from looktwice.model.driving.facts import FACTS, mirrored
from looktwice.model.driving.plan import GROUPS, TICKS, WORDS
from looktwice.model.driving.trajectory import POSE_MIRROR, FloatArray
from looktwice.model.network.codec import TrajectoryCodec
from looktwice.model.network.fact_reader import likely
from looktwice.model.network.intent import IntentTrunk
from looktwice.model.network.motion import present_speeds
from looktwice.model.network.trajectory_head import TrajectoryHead
from looktwice.model.network.vla import LookTwiceVla
from looktwice.model.training.batches import mean_values
from looktwice.model.training.examples import Examples
from looktwice.model.training.grounding import fact_loss, fact_weights
from looktwice.model.training.misread import misread
from looktwice.model.training.vision_cache import VisionCache

Source = Literal["tracks", "scene"]
_BATCH: Final = 64
_DROPOUT: Final = 0.2
_WORDS_WEIGHT: Final = 2.0
_FACTS_WEIGHT: Final = 0.5


class IntentSample(NamedTuple):
    """One scene; shapes as in `Examples`, for one example; ``read`` [facts], or empty without pictures."""

    history: npt.NDArray[np.float32]
    route: npt.NDArray[np.float32]
    has_route: npt.NDArray[np.bool_]
    tracks: npt.NDArray[np.float32]
    futures: npt.NDArray[np.float32]
    plan_bins: npt.NDArray[np.int8]
    facts: npt.NDArray[np.float32]
    read: npt.NDArray[np.float32]


class IntentDataset(Dataset[IntentSample]):
    """All examples, each time mirrored or not and with or without its route, by chance.

    Args:
        examples: to learn from.
        read: [N, mirrored or not, route or none, facts] of `read_facts`; None to learn from tracks alone.
        route_share: share that is given its route.
        seed: of what is left to chance.
    """

    def __init__(
        self, examples: Examples, read: FloatArray | None, route_share: float, seed: int = 0
    ) -> None:
        self._examples, self._read, self._route_share = examples, read, route_share
        self.random = np.random.default_rng(seed)
        self._mirrored_bins = np.stack([examples.plan(i).mirrored().bins() for i in range(len(examples))])
        self._nothing = np.zeros(0, np.float32)

    def __len__(self) -> int:
        return len(self._examples)

    def __getitem__(self, index: int) -> IntentSample:
        chance = self.random.random(2)
        return self.look(index, mirror=bool(chance[0] < 0.5), route=bool(chance[1] < self._route_share))

    def look(self, index: int, *, mirror: bool, route: bool) -> IntentSample:
        """One example as it is asked for."""
        examples = self._examples
        history, way, has_route = examples.motion(index, mirror=mirror, route=route)
        future, facts = examples.future[index], examples.facts[index]
        tracks = examples.tracks_given(index, mirror=mirror, route=has_route)
        bins = examples.plan_bins[index]
        if mirror:
            future = future * POSE_MIRROR
            bins, facts = self._mirrored_bins[index], mirrored(facts)
        read = self._nothing if self._read is None else self._read[index, int(mirror), int(has_route)]
        return IntentSample(history, way, np.array(has_route), tracks, future, bins, facts, read)


@torch.inference_mode()
def read_facts(
    vla: LookTwiceVla, examples: Examples, vision: VisionCache, seed: int = 0, misread_share: float = 1.0
) -> FloatArray:
    """What is read from pictures of examples, float32 [N, plain and mirrored, without and with route, facts].

    Examples without pictures are `misread` as those with pictures are, or keep what is true, and NaN where a
    fact does not apply. Without mirror images in ``vision`` only the examples themselves are read:
    [N, 1, 2, facts].

    Args:
        vla: whose resampler reads.
        examples: to read.
        vision: what its tower sees in them.
        seed: of the errors in examples without pictures.
        misread_share: of them that are misread.
    """
    assert vla.resampler is not None
    sides = 1 + vision.mirrored
    read = np.empty((len(examples), sides, 2, len(FACTS)), np.float32)
    pictured, random = examples.pictured, np.random.default_rng(seed)
    with_pictures, device = np.flatnonzero(pictured), vla.device
    misreading = ~pictured & (random.random(len(examples)) < misread_share)
    for side in range(sides):
        truth = mirrored(examples.facts) if side else examples.facts
        flip = POSE_MIRROR if side else np.ones(4, np.float32)
        history, route = examples.history * flip, np.nan_to_num(examples.route) * flip[:2]
        for has_route in range(2):
            for start in range(0, len(with_pictures), _BATCH):
                places = with_pictures[start : start + _BATCH]
                seen = np.stack([vision.tokens(int(place), bool(side)) for place in places])
                known = examples.has_route[places] & bool(has_route)
                inputs = (seen.astype(np.float32), history[places], route[places], known)
                gathered = vla.resampler.gather(*(torch.from_numpy(each).to(device) for each in inputs))
                read[places, side, has_route] = likely(vla.resampler.facts(gathered)).cpu().numpy()
        read[~pictured, side] = truth[~pictured, None]
        if misreading.any():
            there = read[with_pictures, side]
            read[misreading, side] = misread(truth[misreading], truth[with_pictures], there, random, device)
    return read


def read_errors(learner: IntentLearner, examples: Examples, read: FloatArray | None) -> Mapping[str, float]:
    """How well a source is read in held-out scenes: ``plan_ade_m`` and losses, with and without the route.

    The learner is put into evaluation mode meanwhile. Scenes without a route count in both.
    """
    data = IntentDataset(examples, read, route_share=1.0)
    figures: dict[str, float] = {}
    for suffix, route in (("", False), ("+route", True)):
        means = mean_values(learner, partial(data.look, mirror=False, route=route), range(len(data)))
        figures |= {f"{name}/read{suffix}": mean for name, mean in means.items()}
    return figures


class IntentLearner(nn.Module):
    """One source's trunk with its heads; outputs the loss and its parts.

    Args:
        vla: its reader of tracks, or its resampler's intent, is trained in place.
        codec: in whose space trajectories are drawn.
        source: what is read.

    Raises:
        ValueError: the checkpoint has no such part.
    """

    def __init__(self, vla: LookTwiceVla, codec: TrajectoryCodec, source: Source) -> None:
        super().__init__()
        scene = None if vla.resampler is None else vla.resampler.intent
        part: Any = vla.track_reader if source == "tracks" else scene
        if part is None:
            raise ValueError(f"this checkpoint reads no {source}")
        self._source = source
        self.part = part
        width = IntentTrunk.width
        # A sketch is the best guess, which the checkpoint keeps.
        self.trajectory = TrajectoryHead(width, codec, best=part.sketch)
        self.words = nn.Linear(width, TICKS * sum(len(WORDS[group]) for group in GROUPS))
        self.facts = nn.Linear(width, len(FACTS))
        self.register_buffer("fact_weights", fact_weights())

    fact_weights: Tensor

    def forward(
        self,
        history: Tensor,
        route: Tensor,
        has_route: Tensor,
        tracks: Tensor,
        futures: Tensor,
        plan_bins: Tensor,
        facts: Tensor,
        read: Tensor,
    ) -> dict[str, Tensor]:
        """The loss of a batch of `IntentSample`, and its parts without gradients."""
        for layer in self.part.trunk.layers:
            if isinstance(layer, nn.Dropout):
                layer.p = _DROPOUT if self.training else 0.0
        around = tracks if self._source == "tracks" else read
        state = self.part.state(around, history, route, has_route).float()
        planned = self.trajectory.loss(self.trajectory(state), present_speeds(history), futures)
        words = self._word_loss(state, plan_bins.long())
        of_facts = fact_loss(self.facts(state), facts, self.fact_weights)
        loss = planned["loss"] + _WORDS_WEIGHT * words + _FACTS_WEIGHT * of_facts
        return {
            "loss": loss,
            "plan_ade_m": planned["ade_m"],
            "word_loss": words.detach(),
            "fact_loss": of_facts.detach(),
        }

    def _word_loss(self, state: Tensor, plan_bins: Tensor) -> Tensor:
        """Nats a bin of plans int64 [b, 3, 64]; bins of absent groups count nothing."""
        logits = self.words(state).view(len(state), TICKS, -1)
        losses, first = [], 0
        for number, group in enumerate(GROUPS):
            share = logits[..., first : first + len(WORDS[group])]
            first += len(WORDS[group])
            losses.append(
                F.cross_entropy(share.flatten(0, 1), plan_bins[:, number].flatten(), ignore_index=-1)
            )
        return torch.stack(losses).mean()
