"""Reflections in Parquet files: one row a reflection, with its provenance; the D_CF of CF-VLA section 3.3.

A file carries ``looktwice.reflection_version`` in its metadata; readers refuse other versions. It is written
to a temporary name beside its place and renamed, so a reader never meets half a file.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal

import pyarrow as pa

from looktwice.model.driving.mends import MENDS, Mend
from looktwice.model.driving.parquet_rows import read_rows, write_rows
from looktwice.model.driving.plan import Plan, PlanError, parse_plan

REFLECTION_VERSION: Final = "4"
_VERSION_KEY: Final = b"looktwice.reflection_version"
_ROW_GROUP: Final = 4096


class ReflectionFileError(ValueError):
    """A file of reflections that is missing, damaged, of another version, or holds a row that is none."""


@dataclass(frozen=True)
class LabelledReflection:
    """A model's own plan in a scene, why it is to be corrected, and the better plan; with its provenance.

    Attributes:
        scene_id: of a scene in the scene store.
        predicted_plan: what the model planned.
        reflection: a teacher's paragraph; empty where the plan is right and is to be acted on.
        expert_plan: what it leads to: the mended plan, or the expert's, of which a reflection in phrases
            takes over the tracks that it speaks of.
        mend: that leads from the plan's trajectory to the better one, one of `MENDS`; empty where nothing is
            to be changed.
        judged: whether it is known that the plan deserves a second look, or none; see `Counterfactual`.
        route, tracks: whether the model was told the route, and the tracks of what is around.
        key: of the label in the ledger it comes from.
        model, model_revision: who planned.
        teacher, teacher_revision: who wrote; empty where nobody did.
        attempts: how often the teacher was asked.
        labelled_at: ISO 8601, UTC.
    """

    scene_id: str
    predicted_plan: Plan
    reflection: str
    expert_plan: Plan
    mend: Mend | Literal[""]
    judged: bool
    route: bool
    tracks: bool
    key: str
    model: str
    model_revision: str
    teacher: str
    teacher_revision: str
    attempts: int
    labelled_at: str


_FLAGS: Final = ("judged", "route", "tracks")
_SCHEMA: Final = pa.schema(
    [
        (name, {"attempts": pa.int32()}.get(name, pa.bool_() if name in _FLAGS else pa.string()))
        for name in LabelledReflection.__dataclass_fields__
    ]
)


def write_reflections(path: Path, reflections: Iterable[LabelledReflection]) -> int:
    """Write ``reflections`` to one file and return how many there were; see the module's first lines."""
    schema = _SCHEMA.with_metadata({_VERSION_KEY: REFLECTION_VERSION.encode()})
    return write_rows(path, map(_to_row, reflections), schema, _ROW_GROUP)


def read_reflections(path: Path) -> Iterator[LabelledReflection]:
    """Yield the reflections of a file.

    Raises:
        ReflectionFileError: see the class.
    """
    try:
        for row in read_rows(path, _VERSION_KEY, REFLECTION_VERSION, "reflections", ReflectionFileError):
            yield _from_row(row)
    except (PlanError, TypeError) as error:
        raise ReflectionFileError(f"{path} holds a row that is no reflection: {error}") from error


def _to_row(reflection: LabelledReflection) -> dict[str, Any]:
    plans = {name: str(getattr(reflection, name)) for name in ("predicted_plan", "expert_plan")}
    return asdict(reflection) | plans


def _from_row(row: dict[str, Any]) -> LabelledReflection:
    plans = {name: parse_plan(row[name]) for name in ("predicted_plan", "expert_plan")}
    if row["mend"] and row["mend"] not in MENDS:
        raise TypeError(f"{row['mend']!r} is no mend; those are {', '.join(MENDS)}")
    return LabelledReflection(**(row | plans))
