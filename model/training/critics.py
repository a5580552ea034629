"""Learning what comes of trajectories: from some that were followed, thousands a second.

Each critic (`looktwice.model.network.critic`) learns from what its small planner knows: the facts that are
read from pictures, or the tracks. All else stays as it is.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.data import Dataset

from looktwice.model.driving.followed_store import FollowedTrajectory
from looktwice.model.driving.outcome import VERDICTS
from looktwice.model.driving.trajectory import POSE_MIRROR, FloatArray
from looktwice.model.evaluation.perception import auc
from looktwice.model.network.critic import Critic, objects_of_facts, objects_of_tracks
from looktwice.model.network.route_line import RouteLine
from looktwice.model.network.vla import LookTwiceVla
from looktwice.model.training.batches import stacked
from looktwice.model.training.examples import Examples
from looktwice.model.training.reflections import places_of

_DROPOUT: Final = 0.2
_POSE: Final = [0, 1, 3]
_EVERY: Final = 10
"""Of the episodes, the last of so many is left out."""
_BATCH: Final = 256


class PlacedVerdicts(NamedTuple):
    """Trajectories that were followed, and the example that each begins in.

    Attributes:
        examples: int64 [m], places.
        poses: float32 [m, 64, 4].
        verdicts: int64 [m], places in `VERDICTS`.
    """

    examples: npt.NDArray[np.int64]
    poses: FloatArray
    verdicts: npt.NDArray[np.int64]


def place_verdicts(examples: Examples, followed: Iterable[FollowedTrajectory]) -> PlacedVerdicts:
    """Followed trajectories with the examples of their scenes; raises ValueError where one is missing."""
    found = list(followed)
    if not found:
        raise ValueError("there are no followed trajectories to learn from")
    places = places_of(examples, (each.scene_id for each in found), "a followed trajectory")
    verdicts = np.array([VERDICTS.index(each.verdict) for each in found], np.int64)
    return PlacedVerdicts(places, np.stack([each.trajectory for each in found]), verdicts)


class VerdictSample(NamedTuple):
    """One trajectory; shapes as in `Examples`, for one example; ``poses`` [64, 3], ``read`` [facts]."""

    history: npt.NDArray[np.float32]
    route: npt.NDArray[np.float32]
    has_route: npt.NDArray[np.bool_]
    tracks: npt.NDArray[np.float32]
    read: npt.NDArray[np.float32]
    poses: npt.NDArray[np.float32]
    verdict: npt.NDArray[np.int64]


class VerdictDataset(Dataset[VerdictSample]):
    """All trajectories, each time mirrored or not and with or without its route, by chance.

    Args:
        examples: that they begin in.
        placed: the trajectories.
        read: [N, mirrored or not, route or none, facts] of `read_facts`.
        route_share: share that is given its route.
        seed: of what is left to chance.
    """

    def __init__(
        self, examples: Examples, placed: PlacedVerdicts, read: FloatArray, route_share: float, seed: int = 0
    ) -> None:
        self._examples, self._placed, self._read = examples, placed, read
        self._route_share = route_share
        self.random = np.random.default_rng(seed)

    def __len__(self) -> int:
        return len(self._placed.verdicts)

    def split(self) -> tuple[list[int], list[int]]:
        """Places of trajectories to learn from, and of those in every tenth episode, to tell how well."""
        episode = self._examples.episode[self._placed.examples]
        left_out = np.isin(episode, np.unique(episode)[_EVERY - 1 :: _EVERY])
        return np.flatnonzero(~left_out).tolist(), np.flatnonzero(left_out).tolist()

    def __getitem__(self, index: int) -> VerdictSample:
        chance = self.random.random(2)
        return self.look(index, mirror=bool(chance[0] < 0.5), route=bool(chance[1] < self._route_share))

    def look(self, index: int, *, mirror: bool, route: bool) -> VerdictSample:
        """One trajectory as it is asked for."""
        place = int(self._placed.examples[index])
        history, way, has_route = self._examples.motion(place, mirror=mirror, route=route)
        tracks = self._examples.tracks_given(place, mirror=mirror, route=has_route)
        poses = self._placed.poses[index]
        if mirror:
            poses = poses * POSE_MIRROR
        return VerdictSample(
            history,
            way,
            np.array(has_route),
            tracks,
            self._read[place, int(mirror), int(has_route)],
            poses[:, _POSE].astype(np.float32),
            np.array(self._placed.verdicts[index]),
        )


class CriticLearner(nn.Module):
    """A checkpoint's critics; outputs the loss and its parts.

    Args:
        vla: whose critics are trained in place.

    Raises:
        ValueError: it has none.
    """

    def __init__(self, vla: LookTwiceVla) -> None:
        super().__init__()
        scene = None if vla.resampler is None else vla.resampler.intent
        readers = {"facts": scene, "tracks": vla.track_reader}
        self.critics = nn.ModuleDict(
            {
                name: reader.second.critic
                for name, reader in readers.items()
                if reader is not None and reader.second is not None
            }
        )
        if not self.critics:
            raise ValueError("this checkpoint has no second sketches to judge")

    def verdicts(
        self,
        history: Tensor,
        route: Tensor,
        has_route: Tensor,
        tracks: Tensor,
        read: Tensor,
        poses: Tensor,
    ) -> dict[str, Tensor]:
        """Each critic's logits [b, `VERDICTS`] for a batch of `VerdictSample`."""
        found = dict[str, Tensor]()
        # Metres decide here: mixed precision would round them away.
        with torch.autocast(poses.device.type, enabled=False):
            line = RouteLine.of(route, has_route)
            objects = {"facts": objects_of_facts(read), "tracks": objects_of_tracks(tracks, line)}
            for name, critic in self.critics.items():
                assert isinstance(critic, Critic)
                for layer in critic.trunk:
                    if isinstance(layer, nn.Dropout):
                        layer.p = _DROPOUT if self.training else 0.0
                found[name] = critic(poses[:, None], history, line, objects[name])[:, 0].float()
        return found

    def forward(self, verdict: Tensor, **known: Tensor) -> dict[str, Tensor]:
        """The loss of a batch of `VerdictSample`, and each critic's part of it without gradients."""
        parts = {
            f"{name}_verdict_loss": F.cross_entropy(logits, verdict)
            for name, logits in self.verdicts(**known).items()
        }
        return {"loss": torch.stack([*parts.values()]).sum()} | {
            name: part.detach() for name, part in parts.items()
        }


def told_apart(learner: CriticLearner, data: VerdictDataset, places: Sequence[int]) -> dict[str, float]:
    """How well each critic tells trajectories that fail from those that hold, as AUC.

    Args:
        learner: whose critics; it is evaluated meanwhile.
        data: of trajectories.
        places: of those that it has not learned from.
    """
    was_training = learner.training
    learner.eval()
    fails, scores = [], dict[str, list[Tensor]]()
    with torch.inference_mode():
        for start in range(0, len(places), _BATCH):
            some = places[start : start + _BATCH]
            batch = stacked([data.look(place, mirror=False, route=True) for place in some])
            fails.append(batch.pop("verdict") > 0)
            for name, logits in learner.verdicts(**batch).items():
                scores.setdefault(name, []).append(1 - logits.softmax(dim=1)[:, 0])
    learner.train(was_training)
    failed = torch.cat(fails).numpy()
    figures = {name: auc(torch.cat(each).numpy(), failed) for name, each in scores.items()}
    return {f"{name}_verdict_auc": figure for name, figure in figures.items() if figure is not None}
