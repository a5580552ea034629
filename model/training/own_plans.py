"""Plans that the model might write itself, for trajectories to be learned behind.

Learned behind the expert's plans alone, a trajectory trusts its plan too much: the plans that a model writes
are often wrong. Writing them for every example would cost hours. The state of the small planner that the
model writes its plans from costs nothing, and a linear reading of it says how likely each meta-action is.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from looktwice.model.driving.labeller import labelled_track
from looktwice.model.driving.plan import GROUPS, TICKS, WORDS, Plan
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.network.intent import IntentTrunk
from looktwice.model.network.second_sketch import CurveSpace
from looktwice.model.network.trajectory_head import spread_of
from looktwice.model.network.vla import LookTwiceVla
from looktwice.model.training.batches import stacked
from looktwice.model.training.examples import Examples
from looktwice.model.training.intents import IntentDataset, read_facts
from looktwice.model.training.sketched_looks import Around, SecondSketches, second_sketches
from looktwice.model.training.vision_cache import VisionCache

_BATCH: Final = 256
_EPOCHS: Final = 7
_LEAST_STEPS: Final = 300
_RATE: Final = 2e-3
_SIZES: Final = [len(WORDS[group]) for group in GROUPS]


class OwnPlans:
    """Draws plans as the small planners of a checkpoint would write them.

    Args:
        vla: whose planners are read.
        examples: to plan for.
        vision: what its tower sees in them; None to plan from tracks alone.
        seed: of the reading, and of what is misread where there are no pictures.
    """

    def __init__(
        self, vla: LookTwiceVla, examples: Examples, vision: VisionCache | None, seed: int = 0
    ) -> None:
        read = None if vision is None else read_facts(vla, examples, vision, seed)
        data = IntentDataset(examples, read, route_share=1.0)
        books = vla.sketch_books
        spread = None if books is None else spread_of(books.books[0])
        space = None if books is None else books.space
        self._readings = {}
        if vla.track_reader is not None:
            self._readings[True] = _Reading(vla.track_reader, data, "tracks", spread, space, seed)
        if read is not None and vla.resampler is not None:
            self._readings[False] = _Reading(vla.resampler.intent, data, "read", spread, space, seed)

    def draw(
        self, index: int, random: np.random.Generator, *, mirror: bool, route: bool, tracks: bool
    ) -> Plan:
        """A plan for one example, as its prompt shows it.

        Raises:
            KeyError: the checkpoint has no planner for what the prompt shows.
        """
        scores = self._readings[tracks].scores(index, int(mirror), int(route))
        # One draw of noise a word, not one a tick: a plan is in doubt as a whole.
        scores = scores + random.gumbel(size=(1, scores.shape[1])).astype(np.float32)
        tracks_of_groups = {}
        for group, each in zip(GROUPS, np.split(scores, np.cumsum(_SIZES)[:-1], axis=1), strict=True):
            tracks_of_groups[group] = labelled_track([WORDS[group][best] for best in each.argmax(axis=1)])
        return Plan(**tracks_of_groups)

    def sketch(self, index: int, *, mirror: bool, route: bool, tracks: bool) -> FloatArray:
        """The trajectory [d], in the codec's space, that the prompt of one example sketches.

        Raises:
            KeyError: the checkpoint has no planner for what the prompt shows.
            ValueError: it sketches nothing.
        """
        sketches = self._readings[tracks].sketches
        if sketches is None:
            raise ValueError("this checkpoint sketches no trajectories")
        found: FloatArray = sketches[int(mirror), int(route), index]
        return found

    def seconds(self, *, tracks: bool) -> SecondSketches | None:
        """What else might be driven, with or without tracks in the prompt; None where it does not tell.

        Raises:
            KeyError: the checkpoint has no planner for such prompts.
        """
        return self._readings[tracks].seconds


class _Reading:
    """The states of one planner for all examples, and the linear reading of plans from them."""

    def __init__(
        self,
        part: Any,
        data: IntentDataset,
        around: Around,
        spread: Tensor | None,
        space: CurveSpace | None,
        seed: int,
    ) -> None:
        states, bins = [], []
        with torch.inference_mode():
            for mirror in (False, True):
                for route in (False, True):
                    rows, plans = planner_states(part, data, around, mirror=mirror, route=route)
                    states.append(rows)
                    bins.append(plans)
        # [mirror, route, n, width]
        stacked = torch.stack(states).view(2, 2, len(data), IntentTrunk.width).clone()
        self._weight, self._bias = _fit(stacked.flatten(0, 2), torch.cat(bins).clone(), seed)
        self._states = stacked.cpu()
        self.sketches: FloatArray | None = None
        if spread is not None:
            with torch.inference_mode():
                # [mirror, route, n, d]
                self.sketches = (
                    (part.sketch(stacked.to(part.sketch.weight.dtype)).float() * spread).cpu().numpy()
                )
        self.seconds: SecondSketches | None = None
        if part.second is not None and self.sketches is not None and space is not None:
            self.seconds = second_sketches(part, data, around, self.sketches, space)

    def scores(self, index: int, mirror: int, route: int) -> FloatArray:
        """How likely each word is in each tick, log [64, words of all groups]."""
        state = self._states[mirror, route, index].numpy()
        scores: FloatArray = (self._weight @ state + self._bias).reshape(TICKS, sum(_SIZES))
        return scores


def planner_states(
    part: Any, data: IntentDataset, around: str, *, mirror: bool, route: bool
) -> tuple[Tensor, Tensor]:
    """States [n, width] of a small planner for all examples, and the plans in bins [n, groups, 64]."""
    states, bins, device = [], [], next(part.parameters()).device
    for start in range(0, len(data), _BATCH):
        places = range(start, min(start + _BATCH, len(data)))
        batch = stacked([data.look(place, mirror=mirror, route=route) for place in places])
        given = (batch[name].to(device) for name in (around, "history", "route", "has_route"))
        states.append(part.state(*given).float())
        bins.append(batch["plan_bins"].to(device))
    return torch.cat(states), torch.cat(bins)


def _fit(states: Tensor, bins: Tensor, seed: int) -> tuple[FloatArray, FloatArray]:
    """A linear reading of expert plans: weight and bias."""
    words = nn.Linear(states.shape[1], TICKS * sum(_SIZES)).to(states.device)
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.AdamW(words.parameters(), _RATE)
    batch = min(_BATCH, len(states))
    steps = max(_LEAST_STEPS, _EPOCHS * len(states) // batch)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _RATE, steps)
    for _ in range(steps):
        places = torch.randint(len(states), (batch,), generator=generator).to(states.device)
        scores = words(states[places]).view(len(places), TICKS, -1).split(_SIZES, dim=-1)
        taught = bins[places].long()
        losses = [
            F.cross_entropy(each.flatten(0, 1), taught[:, number].flatten(), ignore_index=-1)
            for number, each in enumerate(scores)
        ]
        optimizer.zero_grad()
        torch.stack(losses).sum().backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
    return words.weight.detach().cpu().numpy(), words.bias.detach().cpu().numpy()
