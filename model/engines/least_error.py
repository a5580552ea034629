"""Numbers and trajectory codes of least expected error: the controls ``numbers`` and ``codes``. No torch.

A network that is unsure spreads its probability over codes, or over end times, that lie far apart. What is
drawn from them, or the likeliest, may be a mode that few others support; the one whose expected distance to
what the network believes is least costs the fewest metres (minimum Bayes risk, https://aclanthology.org/N04-1022).
Of evenly spaced numbers that is the median.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from looktwice.model.engines.engine import Controls
from looktwice.model.engines.sampling import Array, probabilities
from looktwice.model.formats.cursor import Allowed
from looktwice.model.network.codec import TrajectoryCodec

Expected = Callable[[Array], Array]
"""From probabilities [k] to the expected error [k] of each choice, in metres or in steps between numbers."""


class CodeIds(Protocol):
    """What is to be known of a tokenizer."""

    def code_ids(self, stage: int) -> range:
        """Ids of the trajectory codes of one stage."""
        ...


class LeastError:
    """Knows for one checkpoint how far apart lies what its tokens stand for."""

    def __init__(self, codec: TrajectoryCodec, vocabulary: CodeIds) -> None:
        self._codes_apart_m: Final = codec.code_distances_m().astype(np.float64)
        self._stages: Final = {
            vocabulary.code_ids(stage).start: stage for stage in range(len(self._codes_apart_m))
        }

    def expected(self, allowed: Allowed, controls: Controls) -> Expected | None:
        """The expected error of choosing each allowed id; None where the next token is drawn."""
        if allowed.ranks is not None:
            return partial(_steps_off, allowed.ranks) if controls.numbers == "least_error" else None
        if controls.codes == "drawn" or len(allowed.ids) != self._codes_apart_m.shape[1]:
            return None
        stage = self._stages.get(int(allowed.ids[0]))
        return None if stage is None else partial(_metres_off, self._codes_apart_m[stage])


def least_error(logits: Array, expected: Expected, left: npt.NDArray[np.bool_] | None = None) -> int:
    """The place of the choice that is expected to be off the least.

    Args:
        logits: float64 [k], believed as they are, whatever the temperature.
        expected: the error of each, see `LeastError.expected`.
        left: bool [k], which may be chosen; they alone are believed in, too. All without it.
    """
    if left is None:
        return int(np.argmin(expected(probabilities(logits))))
    errors = expected(probabilities(np.where(left, logits, -np.inf)))
    return int(np.argmin(np.where(left, errors, np.inf)))


def _metres_off(apart_m: Array, believed: Array) -> Array:
    errors_m: Array = believed @ apart_m
    return errors_m


def _steps_off(ranks: npt.NDArray[np.int64], believed: Array) -> Array:
    """float64 [k]: the mean distance of each rank to the others, without a table of k x k."""
    ordered = np.empty_like(believed)
    ordered[ranks] = believed
    below = np.cumsum(ordered)[:-1]
    first = ordered @ np.arange(len(ordered))
    # One step up is a step away from all that is below, and towards the rest.
    errors: Array = np.concatenate([[first], first + np.cumsum(2 * below - 1)])
    return errors[ranks]
