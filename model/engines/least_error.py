"""Numbers and codes of least expected error: the controls ``numbers`` and ``codes``. No torch.

A network that is unsure spreads its probability over codes, or over end times, that lie far apart. What is
drawn from them, or the likeliest, may be a mode that few others support; the one whose expected distance to
what the network believes is least costs the fewest metres (minimum Bayes risk, https://aclanthology.org/N04-1022).
Of evenly spaced numbers that is the median, and of a picture's code the median of each of its levels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from looktwice.model.engines.engine import Controls
from looktwice.model.engines.sampling import Array, probabilities
from looktwice.model.families.picture_codes import LEVELS, PICTURE, PICTURE_CODEBOOK, levels_of
from looktwice.model.formats.cursor import Allowed
from looktwice.model.network.codec import TrajectoryCodec

_NUMBER: Final = np.repeat(np.arange(len(LEVELS)), LEVELS)
_LEVEL: Final = np.concatenate([np.arange(count) for count in LEVELS])
"""int64 [23], of all levels of a picture code's four numbers: which number, and which level of it."""
_PLACE: Final = _LEVEL / (np.array(LEVELS) - 1)[_NUMBER]
_LEVELS_APART: Final = np.abs(_PLACE[:, None] - _PLACE) * (_NUMBER[:, None] == _NUMBER)
"""float64 [23, 23]; levels of different numbers have nothing to do with each other."""
_HAS_LEVEL: Final = (levels_of(range(PICTURE_CODEBOOK)).T[_NUMBER] == _LEVEL[:, None]).astype(np.float64)
"""float64 [23, 1000]: 1.0 where a code has a level."""

Expected = Callable[[Array], Array]
"""From probabilities [k] to the expected error [k] of each choice: in metres, in steps between numbers, or in
shares of the way between a picture's outermost levels."""


class CodeIds(Protocol):
    """What is to be known of a tokenizer."""

    def code_ids(self, stage: int) -> range:
        """Ids of the trajectory codes of one stage."""
        ...

    @property
    def alphabets(self) -> Mapping[str, tuple[range, ...]]:
        """Ids of named alphabets, of picture codes among them."""
        ...


class LeastError:
    """Knows for one checkpoint how far apart lies what its tokens stand for."""

    def __init__(self, codec: TrajectoryCodec, vocabulary: CodeIds) -> None:
        self._codes_apart_m: Final = codec.code_distances_m().astype(np.float64)
        self._stages: Final = {
            vocabulary.code_ids(stage).start: stage for stage in range(len(self._codes_apart_m))
        }
        pictures = vocabulary.alphabets.get(PICTURE)
        self._picture_ids: Final = pictures[0] if pictures else None

    def expected(self, allowed: Allowed, controls: Controls) -> Expected | None:
        """The expected error of choosing each allowed id; None where the next token is drawn."""
        if allowed.ranks is not None:
            return expected_number_error(allowed, controls)
        if controls.codes == "drawn":
            return None
        first, count = int(allowed.ids[0]), len(allowed.ids)
        if self._picture_ids is not None and (first, count) == (self._picture_ids.start, PICTURE_CODEBOOK):
            return _levels_off
        if count != self._codes_apart_m.shape[1]:
            return None
        stage = self._stages.get(first)
        return None if stage is None else partial(_metres_off, self._codes_apart_m[stage])


def expected_number_error(allowed: Allowed, controls: Controls) -> Expected | None:
    """As `LeastError.expected`, of numbers alone, whose steps are the same in every checkpoint."""
    if allowed.ranks is None or controls.numbers == "drawn":
        return None
    return partial(_steps_off, allowed.ranks)


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


def _levels_off(believed: Array) -> Array:
    """float64 [1000]: the mean distance of each picture code to the others, summed over its levels."""
    errors: Array = _LEVELS_APART @ (_HAS_LEVEL @ believed) @ _HAS_LEVEL
    return errors


def _steps_off(ranks: npt.NDArray[np.int64], believed: Array) -> Array:
    """float64 [k]: the mean distance of each rank to the others, without a table of k x k."""
    ordered = np.empty_like(believed)
    ordered[ranks] = believed
    below = np.cumsum(ordered)[:-1]
    first = ordered @ np.arange(len(ordered))
    # One step up is a step away from all that is below, and towards the rest.
    errors: Array = np.concatenate([[first], first + np.cumsum(2 * below - 1)])
    return errors[ranks]
