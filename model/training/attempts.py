"""A model's own answers with feedback on them, found again among the examples that are trained on."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.feedback_store import FeedbackRow
from looktwice.model.driving.trajectory import TIMES_OF, FloatArray, at_times
from looktwice.model.families.family import Attempt, JudgedAttempt
from looktwice.model.training.examples import Examples
from looktwice.model.training.reflections import places_of, plain


class PlacedAttempts(NamedTuple):
    """Attempts, and the place of the example that each is on, int64 [m]."""

    examples: npt.NDArray[np.int64]
    attempts: list[JudgedAttempt]


def place_attempts(
    examples: Examples,
    rows: Iterable[FeedbackRow],
    times_s: Sequence[float],
    taught: npt.NDArray[np.bool_],
) -> PlacedAttempts:
    """Answers with their feedback, in plain punctuation, with the examples of their scenes.

    Wrong answers are taught by the expert's response, so those in scenes that tell none are left out.

    Args:
        examples: to look in.
        rows: of a file.
        times_s: of the poses of drafts.
        taught: bool [N], of which examples the expert's response is known.

    Raises:
        ValueError: a scene is missing, or a right answer does not say what led to it.
    """
    told = list(rows)
    places = places_of(examples, (row.scene_id for row in told), "feedback")
    kept = [number for number, row in enumerate(told) if row.correct or taught[places[number]]]
    return PlacedAttempts(places[kept], [_attempt(told[number], times_s) for number in kept])


def fails(examples: Examples, rows: Iterable[FeedbackRow]) -> npt.NDArray[np.bool_]:
    """In which examples a model gave a wrong answer, bool [N].

    Raises:
        ValueError: a scene is missing.
    """
    failed = np.zeros(len(examples), np.bool_)
    failed[places_of(examples, (row.scene_id for row in rows if not row.correct), "feedback")] = True
    return failed


def half_failed(learned: npt.NDArray[np.bool_], failed: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """The places of the examples that are learned from, those that failed so often that they are half.

    Failures alone would teach to brake whatever comes: most of them are collisions, or nearly.

    Args:
        learned, failed: bool [N], which examples are.

    Raises:
        ValueError: none of them failed.
    """
    often, once = np.flatnonzero(learned & failed), np.flatnonzero(learned & ~failed)
    if not len(often):
        raise ValueError("no answer in a scene that can be learned from is wrong")
    return np.concatenate([once, np.repeat(often, max(1, round(len(once) / len(often))))])


def _attempt(row: FeedbackRow, times_s: Sequence[float]) -> JudgedAttempt:
    if row.correct and not row.think:
        raise ValueError(
            f"draw {row.draw} in scene {row.scene_id} is right and has no thoughts to be taught: "
            "`looktwice failures --format` names the format that the model is to answer in"
        )
    draft = Attempt(_poses(row, times_s), plain(row.feedback))
    return JudgedAttempt(draft, plain(row.think or ""), row.correct)


def _poses(row: FeedbackRow, times_s: Sequence[float]) -> FloatArray:
    """The trajectory of a row, float32 [t, 4]."""
    told = np.array(row.trajectory, np.float32)
    poses = np.zeros((len(told), 4), np.float32)
    poses[:, [0, 1, 3]] = told
    return at_times(poses, TIMES_OF[len(told)], times_s)
