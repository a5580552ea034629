"""The trajectory code of least expected error: the control ``codes``. No torch.

A network that is unsure spreads its probability over codes that lie far apart. A code drawn from them, or the
likeliest, may be a mode that few others support; the one whose expected distance to what the network believes
is least costs the fewest metres (minimum Bayes risk, https://aclanthology.org/N04-1022).
"""

from __future__ import annotations

from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from model.engines.sampling import Array, probabilities
from model.network.codec import TrajectoryCodec


class CodeIds(Protocol):
    """What is to be known of a tokenizer."""

    def code_ids(self, stage: int) -> range:
        """Ids of the trajectory codes of one stage."""
        ...


class LeastError:
    """Chooses codes for one checkpoint."""

    def __init__(self, codec: TrajectoryCodec, vocabulary: CodeIds) -> None:
        self._distances_m: Final = codec.code_distances_m().astype(np.float64)
        self._stages: Final = {
            vocabulary.code_ids(stage).start: stage for stage in range(len(self._distances_m))
        }

    def stage(self, ids: npt.NDArray[np.int64]) -> int | None:
        """Whose codes the allowed ``ids`` are; None where they are none."""
        whole = len(ids) == self._distances_m.shape[1]
        return self._stages.get(int(ids[0])) if whole else None

    def choose(self, stage: int, logits: Array, left: npt.NDArray[np.bool_] | None = None) -> int:
        """The place in logits [K] of the code of least expected error.

        Args:
            stage: whose codes they are.
            logits: of all codes of the stage; believed as they are, whatever the temperature.
            left: bool [K], which codes may be chosen; they alone are believed in, too. All without it.
        """
        believed = logits if left is None else np.where(left, logits, -np.inf)
        expected_m = probabilities(believed) @ self._distances_m[stage]
        return int(np.argmin(expected_m if left is None else np.where(left, expected_m, np.inf)))
