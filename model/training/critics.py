"""Learning what comes of trajectories: from sketches and alternatives that were judged, thousands a second.

Each critic (`looktwice.model.network.critic`) learns from what its small planner knows: the facts that are
read from pictures, or the tracks. All else stays as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.data import Dataset

from looktwice.model.driving.trajectory import POSE_MIRROR, FloatArray
from looktwice.model.evaluation.perception import auc
from looktwice.model.network.alternatives import with_alternatives
from looktwice.model.network.critic import Critic, objects_of_facts, objects_of_tracks
from looktwice.model.network.route_line import RouteLine
from looktwice.model.network.vla import LookTwiceVla
from looktwice.model.training.batches import stacked
from looktwice.model.training.examples import Examples
from looktwice.model.training.judged_sketches import SOURCES, JudgedSketches

_DROPOUT: Final = 0.1
_MIRROR: Final = POSE_MIRROR[[0, 1, 3]]
_EVERY: Final = 10
"""Of the episodes, the last of so many is left out."""
_BATCH: Final = 256


class VerdictSample(NamedTuple):
    """One sketch; shapes as in `Examples`, for one example.

    ``read`` [facts], ``poses`` [64, 3], and the ``verdicts`` [1 + alternatives] on it and its alternatives.
    """

    history: npt.NDArray[np.float32]
    route: npt.NDArray[np.float32]
    has_route: npt.NDArray[np.bool_]
    tracks: npt.NDArray[np.float32]
    read: npt.NDArray[np.float32]
    poses: npt.NDArray[np.float32]
    verdicts: npt.NDArray[np.int64]


class VerdictDataset(Dataset[VerdictSample]):
    """All sketches, each time mirrored or not by chance, with the route where it was known to who drew it.

    Args:
        examples: that they begin in.
        judged: the sketches.
        read: [N, mirrored or not, route or none, facts] of `read_facts`.
        seed: of what is left to chance.
    """

    def __init__(self, examples: Examples, judged: JudgedSketches, read: FloatArray, seed: int = 0) -> None:
        self._examples, self._judged, self._read = examples, judged, read
        self.random = np.random.default_rng(seed)

    def __len__(self) -> int:
        return len(self._judged.examples) * len(SOURCES)

    def split(self) -> tuple[list[int], list[int]]:
        """Places of sketches to learn from, and of those in every tenth episode, to tell how well."""
        episode = self._examples.episode[self._judged.examples]
        left_out = np.isin(episode, np.unique(episode)[_EVERY - 1 :: _EVERY]).repeat(len(SOURCES))
        return np.flatnonzero(~left_out).tolist(), np.flatnonzero(left_out).tolist()

    def __getitem__(self, index: int) -> VerdictSample:
        return self.look(index, mirror=bool(self.random.random() < 0.5))

    def look(self, index: int, *, mirror: bool) -> VerdictSample:
        """One sketch as it is asked for."""
        row, source = divmod(index, len(SOURCES))
        place, (_, route) = int(self._judged.examples[row]), SOURCES[source]
        history, way, has_route = self._examples.motion(place, mirror=mirror, route=route)
        poses = self._judged.poses[row, source]
        return VerdictSample(
            history,
            way,
            np.array(has_route),
            self._examples.tracks_given(place, mirror=mirror, route=has_route),
            self._read[place, int(mirror), int(has_route)],
            poses * _MIRROR if mirror else poses,
            self._judged.verdicts[row, source],
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
        """Each critic's logits [b, 1 + alternatives, `VERDICTS`] for a batch of `VerdictSample`."""
        found = dict[str, Tensor]()
        # Metres decide here: mixed precision would round them away.
        with torch.autocast(poses.device.type, enabled=False):
            line = RouteLine.of(route, has_route)
            ways = with_alternatives(poses, history, line)
            objects = {"facts": objects_of_facts(read), "tracks": objects_of_tracks(tracks, line)}
            for name, critic in self.critics.items():
                assert isinstance(critic, Critic)
                for layer in critic.trunk:
                    if isinstance(layer, nn.Dropout):
                        layer.p = _DROPOUT if self.training else 0.0
                found[name] = critic(ways, history, line, objects[name])
        return found

    def forward(self, verdicts: Tensor, **known: Tensor) -> dict[str, Tensor]:
        """The loss of a batch of `VerdictSample`, and each critic's part of it without gradients."""
        parts = {
            f"{name}_verdict_loss": F.cross_entropy(logits.flatten(0, 1), verdicts.flatten())
            for name, logits in self.verdicts(**known).items()
        }
        return {"loss": torch.stack([*parts.values()]).sum()} | {
            name: part.detach() for name, part in parts.items()
        }


def told_apart(learner: CriticLearner, data: VerdictDataset, places: Sequence[int]) -> dict[str, float]:
    """How well each critic tells sketches and alternatives that fail from those that hold, as AUC.

    Args:
        learner: whose critics; it is evaluated meanwhile.
        data: of sketches.
        places: of those that it has not learned from.
    """
    was_training = learner.training
    learner.eval()
    fails, scores = [], dict[str, list[Tensor]]()
    with torch.inference_mode():
        for start in range(0, len(places), _BATCH):
            batch = stacked([data.look(place, mirror=False) for place in places[start : start + _BATCH]])
            fails.append(batch.pop("verdicts").flatten() > 0)
            for name, logits in learner.verdicts(**batch).items():
                scores.setdefault(name, []).append(1 - logits.softmax(dim=2)[..., 0].flatten())
    learner.train(was_training)
    failed = torch.cat(fails).numpy()
    figures = {name: auc(torch.cat(each).numpy(), failed) for name, each in scores.items()}
    return {f"{name}_verdict_auc": figure for name, figure in figures.items() if figure is not None}
