"""Feedback on a model's own responses in Parquet files: the feedback set of ELF-VLA section 7.2.

A file carries ``looktwice.feedback_version`` in its metadata; readers refuse other versions. It is written to
a temporary name beside its place and renamed, so a reader never meets half a file.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import pyarrow as pa

from looktwice.model.driving.parquet_rows import read_rows, write_rows

FEEDBACK_VERSION: Final = "1"
_VERSION_KEY: Final = b"looktwice.feedback_version"
_ROW_GROUP: Final = 1024


class FeedbackFileError(ValueError):
    """A file of feedback that is missing, damaged, or of another version."""


@dataclass(frozen=True)
class FeedbackRow:
    """A model's response in a scene, what it is worth, and the feedback on it; with its provenance.

    Attributes:
        scene_id: of a scene in the scene store.
        draw: which of the scene's draws.
        plan, think: what the model wrote; None where its family writes none.
        trajectory: 8 poses at 0.5 s or 64 at 0.1 s: x, y, heading of the box's centre.
        version: of the score.
        score: that it was judged by; partial where sub-scores are missing.
        is_partial: which of the two.
        threshold, correct: what it was held to, and whether it is at least that.
        feedback: the verdict by rule, or five sections
            (`looktwice.model.driving.pdm.feedback.parse_feedback`).
        facts: of the failure, in JSON.
        model, model_revision: who planned.
        teacher, teacher_revision: who wrote.
        attempts: how often the teacher was asked; 0 where nobody was.
        key: in the ledger that it comes from.
        written_at: ISO 8601, UTC.
    """

    scene_id: str
    draw: int
    plan: str | None
    think: str | None
    trajectory: list[list[float]]
    version: str
    score: float
    is_partial: bool
    threshold: float
    correct: bool
    feedback: str
    facts: str
    model: str
    model_revision: str
    teacher: str
    teacher_revision: str
    attempts: int
    key: str
    written_at: str


_TYPES: Final = {
    "int": pa.int32(),
    "float": pa.float64(),
    "bool": pa.bool_(),
    "list[list[float]]": pa.list_(pa.list_(pa.float32())),
}
"""Of columns, by what a row holds; all others are texts."""
_SCHEMA: Final = pa.schema(
    [(name, _TYPES.get(kind, pa.string())) for name, kind in FeedbackRow.__annotations__.items()]
)


def write_feedback(path: Path, rows: Iterable[FeedbackRow]) -> int:
    """Write ``rows`` to one file and return how many there were; see the module's first lines."""
    schema = _SCHEMA.with_metadata({_VERSION_KEY: FEEDBACK_VERSION.encode()})
    return write_rows(path, map(asdict, rows), schema, _ROW_GROUP)


def read_feedback(path: Path) -> Iterator[FeedbackRow]:
    """Yield the rows of a file.

    Raises:
        FeedbackFileError: see the class.
    """
    try:
        for row in read_rows(path, _VERSION_KEY, FEEDBACK_VERSION, "feedback", FeedbackFileError):
            yield FeedbackRow(**row)
    except TypeError as error:
        raise FeedbackFileError(f"{path} is damaged: {error}") from error
