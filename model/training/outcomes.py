"""Learning from what comes of the network's own draws: they are made, judged and learned from in one step.

Words, times and the branch are drawn, and learned from by `model.training.policy`; trajectory codes are those
of least expected error, as they are when it drives, and are learned from the expert beside it. The policy is
the distribution that decodes: over the tokens that the format allows, at the temperature of the draws.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from model.driving.scene import LabelledScene
from model.engines.engine import Controls, Draw, PlanRequest
from model.engines.torch.offline import draws_of
from model.engines.torch.runner import Runner
from model.families.trajectory_codes import TRAJECTORY
from model.formats.replay import Decision, decisions
from model.network.checkpoint import Loaded
from model.training.batches import Item, ResponseDataset, Sample, collate
from model.training.learner import ResponseLearner
from model.training.policy import advantages, policy_loss
from model.training.recipes import OutcomeSettings
from model.training.rewards import rewards
from model.training.rollouts import with_draws

_MAX_SEED = 2**31


class ScenePlaces(Dataset[int]):
    """The places of examples to learn from; what is asked of them is left to `OutcomeLearner`."""

    def __init__(self, places: Sequence[int]) -> None:
        self._places = places

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> int:
        return self._places[index]


def collate_places(places: list[int]) -> dict[str, Tensor]:
    """A batch for `OutcomeLearner`."""
    return {"places": torch.tensor(places)}


class OutcomeLearner(nn.Module):
    """A step of outcome training; a batch is places of scenes, the output the loss and what is worth logging.

    Args:
        learner: holds the network, and learns the expert's responses beside its own draws.
        loaded: the same network, as engines take it.
        data: renders the prompts of all examples.
        scenes: the same examples, with what is needed to judge plans.
        task: the response format.
        settings: see there.
        route_share, tracks_share: shares of the scenes that are given their route, and their tracks.

    Raises:
        ValueError: scenes and examples are not the same.
    """

    def __init__(
        self,
        learner: ResponseLearner,
        loaded: Loaded,
        data: ResponseDataset,
        scenes: Sequence[LabelledScene],
        task: str,
        settings: OutcomeSettings,
        *,
        route_share: float,
        tracks_share: float,
    ) -> None:
        super().__init__()
        if len(scenes) != len(data):
            raise ValueError(f"{len(scenes)} scenes do not go with {len(data)} examples")
        self.learner = learner
        self._loaded, self._data, self._scenes = loaded, data, scenes
        self._task, self._settings = task, settings
        self._route_share, self._tracks_share = route_share, tracks_share

    def forward(self, places: Tensor) -> dict[str, Tensor]:
        """The loss of one step from scenes int64 [b], and its parts without gradients."""
        items = [self._item(place) for place in places.tolist()]
        draws = self._draws(items)
        judged = [
            rewards(self._scenes[item.index], found, self._settings.rewards)
            for item, found in zip(items, draws, strict=True)
        ]
        reward = torch.from_numpy(np.stack([each for each, _ in judged]))
        samples = [self._data[item] for item in items]
        imitated = self.learner(**collate(samples))
        policy, ratio = self._policy(samples, draws, advantages(reward))
        loss = policy + self._settings.imitation * imitated["loss"]
        names = judged[0][1].keys()
        parts = {name: float(np.mean([told[name] for _, told in judged])) for name in names}
        parts |= {"reward": float(reward.mean()), "reward_spread": float(reward.std(dim=1).mean())}
        return {
            "loss": loss,
            "policy_ratio": ratio,
            "imitation_loss": imitated["loss"].detach(),
            **{name: torch.tensor(value) for name, value in parts.items()},
        }

    def _item(self, place: int) -> Item:
        chance = torch.rand(2).tolist()
        has_route = self._scenes[place].scene.route is not None
        return Item(
            place,
            self._task,
            has_route and chance[0] < self._route_share,
            tracks=chance[1] < self._tracks_share,
        )

    def _draws(self, items: Sequence[Item]) -> list[list[Draw]]:
        """Draws of the network as it stands, in evaluation mode meanwhile."""
        network, settings = self._loaded.model, self._settings
        was_training = network.training
        network.train(False)
        seed = int(torch.randint(_MAX_SEED, ()))
        controls = Controls(
            n=settings.draws,
            temperature=settings.temperature,
            seed=seed,
            numbers="drawn",
            codes="least_error",
            logprobs=True,
        )
        requests = [
            PlanRequest(
                str(number),
                self._scenes[item.index].given(route=item.route, tracks=item.tracks),
                item.task,
                controls,
            )
            for number, item in enumerate(items)
        ]
        device = next(network.parameters()).device
        # The engine's memory has the weights' type, which autocast would not write into it.
        with torch.inference_mode(), torch.autocast(device.type, enabled=False):
            found = draws_of(Runner(self._loaded, len(items) * settings.draws), requests)
        network.train(was_training)
        return list(found.values())

    def _policy(
        self, samples: Sequence[Sample], draws: Sequence[Sequence[Draw]], worth: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The policy's loss and mean ratio; scenes whose draws are worth the same cost nothing."""
        settings = self._settings
        told = [place for place, each in enumerate(worth) if bool(each.any())]
        if not told:
            return worth.new_zeros(()), worth.new_ones(())
        batch = collate([with_draws(samples[place], draws[place]) for place in told])
        responses = [draw for place in told for draw in draws[place]]
        drawn = [self._drawn(draw) for draw in responses]
        now = self.learner.log_probabilities(batch, drawn, settings.temperature)
        before = [
            torch.tensor([draw.logprobs[each.position] for each in made], dtype=torch.float32)
            for draw, made in zip(responses, drawn, strict=True)
        ]
        found = policy_loss(now, before, worth[told].flatten(), clip=settings.clip)
        return found.loss, found.ratio

    def _drawn(self, draw: Draw) -> list[Decision]:
        """The decisions of a draw that were drawn: all but its trajectory codes."""
        format = self._data.formats[self._task]
        codes = self._loaded.vocabulary.alphabets[TRAJECTORY]
        return [
            each
            for each in decisions(format.start(), draw.ids)
            if not any(int(each.ids[0]) in stage for stage in codes)
        ]
