"""Learning from what comes of the network's own draws: they are made, judged and learned from in one step.

Words, numbers and codes are drawn, and learned from by `looktwice.model.training.outcome.policy`: plans with
their times, the branch and the codes of CF-VLA, thoughts and poses of ELF-VLA, all of VLA-World. The policy
is the distribution that decodes: over the tokens that the format allows, at the temperature of the draws.
Beside it the expert is imitated a little, against drivers who find a gap in the score.

Where a draw of a scene fails, the network refines the worst one by feedback, of the built-in teacher or by
rule, which knows what the expert did. The refinement joins the draws as an answer to the first prompt: so the
first answer learns what feedback led to (ELF-VLA section 9).
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from itertools import chain
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from looktwice.model.driving.pdm.judging import PlanExplanation, SceneJudge
from looktwice.model.driving.pdm.labelled import plans_of
from looktwice.model.driving.pdm.rule_teacher import rule_sections, verdict_with_truth
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.engines.engine import Controls, Draw, PlanRequest
from looktwice.model.engines.torch.in_process import draws_of
from looktwice.model.engines.torch.runner import Runner
from looktwice.model.families.family import Attempt
from looktwice.model.families.picture_codes import PICTURE
from looktwice.model.families.registry import family_named
from looktwice.model.families.trajectory_codes import TRAJECTORY
from looktwice.model.formats.replay import Decision, decisions
from looktwice.model.network.checkpoint import Loaded
from looktwice.model.network.vocabulary import Vocabulary
from looktwice.model.training.batches import ResponseSample, collate
from looktwice.model.training.learner import ResponseLearner
from looktwice.model.training.outcome.draw_rewards import Rewards, RewardWeights, family_rewards, rewards
from looktwice.model.training.outcome.policy import PolicyLoss, advantages, divergence, policy_loss
from looktwice.model.training.outcome.rollouts import with_draws
from looktwice.model.training.recipes import FeedbackWriter, OutcomeSettings
from looktwice.model.training.responses import ResponseDataset
from looktwice.model.training.sampler import Item

_MAX_SEED = 2**31


class ScenePlaces(Dataset[int]):
    """The places of examples to learn from; what is asked of them is left to the learner."""

    def __init__(self, places: Sequence[int]) -> None:
        self._places = places

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> int:
        return self._places[index]


def collate_places(places: list[int]) -> dict[str, Tensor]:
    """A batch for `OutcomeLearner` or `LookLearner`."""
    return {"places": torch.tensor(places)}


class _Answers(NamedTuple):
    """What a batch of scenes was answered.

    Attributes:
        samples: the prompts that were answered, with the expert's responses.
        draws, refined: answers to them, and those that were led to and are learned as answers.
        worth: advantages [draws + refined] of each scene.
        parts: means of what they were judged by, to be logged.
    """

    samples: list[ResponseSample]
    draws: list[list[Draw]]
    refined: list[list[Draw]]
    worth: list[Tensor]
    parts: dict[str, float]


class OutcomeLearner(nn.Module):
    """A step of outcome training; a batch is places of scenes, the output the loss and what is worth logging.

    Answers serve as many steps as the settings say. Steps that go on with them leave their own scenes out.

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
        self._task, self._family, self._settings = task, family_named(task), settings
        self._route_share, self._tracks_share = route_share, tracks_share
        self._chosen = _chosen_alphabets(loaded.vocabulary, settings)
        self._runner: Runner | None = None
        self._answers: _Answers | None = None
        self._updates_left = 0
        # In a tuple, so that it is none of this module's own: it is neither trained nor saved.
        self._first = (deepcopy(learner).requires_grad_(False),) if settings.divergence else ()

    def forward(self, places: Tensor) -> dict[str, Tensor]:
        """The loss of one step from scenes int64 [b], and its parts without gradients."""
        if self._answers is None or not self._updates_left:
            self._answers, self._updates_left = self._answered(places), self._settings.updates
        self._updates_left -= 1
        answers = self._answers
        imitated = self.learner(**collate(answers.samples))
        policy, apart = self._policy(answers)
        loss = policy.loss + self._settings.imitation * imitated["loss"]
        parts = answers.parts
        if self._first:
            loss = loss + self._settings.divergence * apart
            parts = parts | {"divergence": float(apart.detach())}
        return {
            "loss": loss,
            "policy_ratio": policy.ratio,
            "policy_clipped": policy.clipped,
            "imitation_loss": imitated["loss"].detach(),
            **{name: torch.tensor(value) for name, value in parts.items()},
        }

    def _answered(self, places: Tensor) -> _Answers:
        """Draws of the network as it stands, refined and judged."""
        if self._runner is not None:
            # The last step has changed the weights.
            with torch.inference_mode():
                self._runner.renew()
        items = [self._item(place) for place in places.tolist()]
        draws = self._drawn_by([self._request(number, item) for number, item in enumerate(items)])
        judges = [SceneJudge(self._scenes[item.index]) for item in items]
        judged = [self._judged(judge, found) for judge, found in zip(judges, draws, strict=True)]
        refined = self._refined(items, judges, draws, judged)
        again = [
            self._judged(judge, found) if found else None
            for judge, found in zip(judges, refined, strict=True)
        ]
        worth = []
        for own, other in zip(judged, again, strict=True):
            group = own.total if other is None else np.concatenate([own.total, other.total])
            worth.append(advantages(torch.from_numpy(group)[None], normalised=self._settings.normalised)[0])
        reward = np.stack([each.total for each in judged])
        parts = {name: float(np.mean([told.parts[name] for told in judged])) for name in judged[0].parts}
        parts |= {"reward": float(reward.mean()), "reward_spread": float(reward.std(axis=1).mean())}
        if self._settings.refining is not None:
            gains = [
                0.0 if other is None else float(other.outcome.mean() - own.outcome.min())
                for own, other in zip(judged, again, strict=True)
            ]
            # Over all scenes of the step: those that are not refined gain nothing.
            refined_rate = float(np.mean([other is not None for other in again]))
            parts |= {"refined_rate": refined_rate, "refined_gain": float(np.mean(gains))}
        return _Answers([self._data[item] for item in items], draws, refined, worth, parts)

    def _item(self, place: int) -> Item:
        chance = torch.rand(2).tolist()
        has_route = self._scenes[place].scene.route is not None
        return Item(
            place,
            self._task,
            has_route and chance[0] < self._route_share,
            tracks=chance[1] < self._tracks_share,
        )

    def _judged(self, judge: SceneJudge, draws: Sequence[Draw]) -> Rewards:
        weights = self._settings.rewards
        if isinstance(weights, RewardWeights):
            return rewards(judge, draws, weights, self._settings.version)
        return family_rewards(self._family, judge.labelled.future, draws, weights)

    def _request(self, number: int, item: Item) -> PlanRequest:
        """A scene's draws, all with random numbers of the step."""
        settings = self._settings
        controls = Controls(
            n=settings.draws,
            temperature=settings.temperature,
            numbers=settings.numbers,
            codes=settings.codes,
            logprobs=True,
        )
        scene = self._scenes[item.index].given(route=item.route, tracks=item.tracks)
        return PlanRequest(str(number), scene, item.task, controls)

    def _drawn_by(self, requests: Sequence[PlanRequest]) -> list[list[Draw]]:
        """Draws of the network as it stands, in evaluation mode meanwhile; with a new seed."""
        network = self._loaded.model
        was_training = network.training
        network.train(False)
        seed = int(torch.randint(_MAX_SEED, ()))
        seeded = [replace(asked, controls=replace(asked.controls, seed=seed)) for asked in requests]
        rows = sum(asked.controls.n for asked in seeded)
        device = next(network.parameters()).device
        # The engine's memory has the weights' type, which autocast would not write into it. A prompt's draws
        # lie beside it; a few places more take those that grow long.
        with torch.inference_mode(), torch.autocast(device.type, enabled=False):
            if self._runner is None or self._runner.rows < rows:
                self._runner = Runner(self._loaded, rows, prompts=min(rows, 2 * len(seeded)))
            found = draws_of(self._runner, seeded)
        network.train(was_training)
        return list(found.values())

    def _refined(
        self,
        items: Sequence[Item],
        judges: Sequence[SceneJudge],
        draws: Sequence[Sequence[Draw]],
        judged: Sequence[Rewards],
    ) -> list[list[Draw]]:
        """Refinements of each scene's worst draw, none where it is good enough."""
        refining, found = self._settings.refining, [list[Draw]() for _ in items]
        if refining is None:
            return found
        failed = [place for place, own in enumerate(judged) if own.outcome.min() < refining.threshold]
        requests = []
        for place in failed:
            asked = self._request(place, items[place])
            requests.append(
                replace(
                    asked,
                    format=refining.format,
                    controls=replace(asked.controls, n=refining.count),
                    attempt=self._attempt(
                        judges[place],
                        draws[place][int(judged[place].outcome.argmin())],
                        refining.feedback,
                    ),
                )
            )
        for place, refinements in zip(failed, self._drawn_by(requests) if requests else (), strict=True):
            found[place] = refinements
        return found

    def _attempt(self, judge: SceneJudge, draft: Draw, writer: FeedbackWriter) -> Attempt:
        """A draft with feedback, measured against the expert."""
        plan = None if draft.plan is None else str(draft.plan)
        said = [PlanExplanation(plan, draft.thinking)]
        [judged] = judge.judged(plans_of(draft.scored[None]), self._settings.version, said=said)
        feedback = str(rule_sections(judged)) if writer == "teacher" else verdict_with_truth(judged)
        return Attempt(draft.trajectory, feedback)

    def _policy(self, answers: _Answers) -> tuple[PolicyLoss, Tensor]:
        """The policy's loss, and its divergence from where it began.

        Scenes whose draws are worth the same cost nothing.
        """
        settings, draws, refined, worth = self._settings, answers.draws, answers.refined, answers.worth
        told = [place for place, each in enumerate(worth) if bool(each.any())]
        if not told:
            return PolicyLoss(torch.zeros(()), torch.ones(()), torch.zeros(())), torch.zeros(())
        rows = [with_draws(answers.samples[place], [*draws[place], *refined[place]]) for place in told]
        batch = collate(list(chain.from_iterable(rows)))
        made, before = list[list[Decision]](), list[Tensor | None]()
        for place in told:
            for draw in draws[place]:
                made.append(self._drawn(draw))
                logprobs = [draw.logprobs[each.position] for each in made[-1]]
                before.append(torch.tensor(logprobs, dtype=torch.float32))
            for draw in refined[place]:
                made.append(self._drawn(draw))
                before.append(None)
        now = self.learner.log_probabilities(batch, made, settings.temperature)
        gamma = {} if settings.refining is None else {"gamma": settings.refining.gamma}
        found = policy_loss(
            now, before, torch.cat([worth[place] for place in told]), clip=settings.clip, **gamma
        )
        apart = torch.zeros(())
        for first in self._first:
            with torch.no_grad():
                here = first.to(found.loss.device)
                then = here.log_probabilities(batch, made, settings.temperature)
            apart = divergence(now, then)
        return found, apart

    def _drawn(self, draw: Draw) -> list[Decision]:
        """The decisions of a draw that were drawn: all but numbers and codes of least expected error."""
        imagination = self._family.imagination
        # Nobody asks for a camera, so nothing is expected of its picture.
        fixed = {} if imagination is None else imagination.fixed_values(None)
        found = decisions(self._data.formats[self._task].start(fixed=fixed), draw.ids)
        return [each for each in found if not any(int(each.ids[0]) in book for book in self._chosen)]


def _chosen_alphabets(vocabulary: Vocabulary, settings: OutcomeSettings) -> list[range]:
    """Ids of the tokens that are chosen by their expected error, and not drawn."""
    return [
        ids
        for name, books in vocabulary.alphabets.items()
        if (settings.codes if name in (TRAJECTORY, PICTURE) else settings.numbers) == "least_error"
        for ids in books
    ]
