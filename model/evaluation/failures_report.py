"""Stages of learning from failures side by side, as tables and as JSON (ELF-VLA, tables 8 and 10)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

from looktwice.model.driving.columns import Columns, aligned
from looktwice.model.driving.pdm.comfort import Version
from looktwice.model.driving.pdm.judged import THRESHOLD
from looktwice.model.driving.pdm.judging import SceneJudge
from looktwice.model.evaluation.bootstrap import Comparison, compare
from looktwice.model.evaluation.figures import FigureRow, figure_table
from looktwice.model.evaluation.scores import (
    SceneScore,
    ScoreTable,
    baseline_planners,
    scene_scores,
    table_of,
)
from looktwice.model.evaluation.stage_results import MEASURES, MeasuredStage
from looktwice.model.evaluation.table import comparison_cells


@dataclass(frozen=True)
class FailuresReport:
    """Stages side by side.

    Attributes:
        scores: of the expert, the baselines and all stages.
        stages: in the order of learning.
        comparisons: each stage against the one before it, the last against the first, refinements against
            what they refine and against new draws.
    """

    scores: ScoreTable
    stages: Sequence[MeasuredStage]
    comparisons: Sequence[Comparison]

    @property
    def rows(self) -> list[FigureRow]:
        """The means of each stage."""
        return [FigureRow.of(stage.name, stage.results, MEASURES) for stage in self.stages]

    def to_json(self) -> dict[str, Any]:
        """All of it as JSON's values."""
        stages = [
            row.to_json()
            | {"refined_below": stage.threshold, "feedback": stage.feedback}
            | {"seed_pdms": list(stage.seed_pdms)}
            for stage, row in zip(self.stages, self.rows, strict=True)
        ]
        return {
            "threshold": THRESHOLD,
            "scores": self.scores.to_json(),
            "stages": stages,
            "comparisons": [asdict(comparison) for comparison in self.comparisons],
        }

    def __str__(self) -> str:
        tables = "\n\n".join("\n".join(aligned(lines)) for lines in self._tables())
        return f"{self.scores}\n\n{tables}\n"

    def _tables(self) -> Iterator[list[list[str]]]:
        rows = self.rows
        answers = figure_table("answers", rows, _ANSWER_COLUMNS, MEASURES)
        answers[0].append("by seed")
        for line, stage in zip(answers[1:], self.stages, strict=True):
            line.append(" ".join(f"{value:.3f}" for value in stage.seed_pdms))
        yield answers
        yield figure_table(f"refine@1, below {THRESHOLD:g}", rows, _REFINE_COLUMNS, MEASURES)
        trained = [
            (stage.threshold, replace(row, name=f"{stage.threshold:g}, {stage.feedback}: {stage.name}"))
            for stage, row in zip(self.stages, rows, strict=True)
            if stage.threshold is not None
        ]
        if len(trained) > 1:
            by_threshold = [row for _, row in sorted(trained, key=lambda each: each[0])]
            yield figure_table("refined in training below", by_threshold, _THRESHOLD_COLUMNS, MEASURES)
        if self.comparisons:
            yield [comparison_cells(comparison) for comparison in self.comparisons]


def failures_report(judges: Sequence[SceneJudge], stages: Sequence[MeasuredStage]) -> FailuresReport:
    """The report of stages that were evaluated on the scenes of ``judges``, in the order of learning.

    Raises:
        ValueError: there are no scenes.
        ScoreError, SolveError: the expert or a baseline cannot be scored.
    """
    found: dict[str, Mapping[Version, Sequence[SceneScore]]] = {
        name: scene_scores(judges, planner) for name, planner in baseline_planners().items()
    }
    found |= {stage.name: stage.scores for stage in stages}
    return FailuresReport(table_of(judges, found), stages, list(_comparisons(stages)))


def _comparisons(stages: Sequence[MeasuredStage]) -> Iterator[Comparison]:
    pairs = list(zip(stages[1:], stages[:-1], strict=True))
    if len(stages) > 2:
        pairs.append((stages[-1], stages[0]))
    for one, other in pairs:
        for measure in ("pdms", "epdms", "both"):
            if _shared(one, other, measure):
                name = f"{one.name} : {other.name}"
                yield compare(name, one.results, other.results, measure)
    for stage in stages:
        if any(each.before is not None for each in stage.results):
            refined = [replace(each, before=each.after) for each in stage.results]
            name = f"{stage.name}, failed: refined : draft"
            yield replace(compare(name, refined, stage.results, "before"), measure="pdms")
            refined = [replace(each, again=each.after) for each in stage.results]
            name = f"{stage.name}, failed: refined : drawn once more"
            yield replace(compare(name, refined, stage.results, "again"), measure="pdms")
        if any(each.refined_pdms is not None for each in stage.results):
            driven = [replace(each, pdms=each.refined_pdms) for each in stage.results]
            yield compare(f"{stage.name}, all: refined where noticed : draft", driven, stage.results, "pdms")


def _shared(one: MeasuredStage, other: MeasuredStage, measure: str) -> bool:
    """Whether some scene has a measure in both."""
    has = [
        {each.scene_id for each in stage.results if getattr(each, measure) is not None}
        for stage in (one, other)
    ]
    return bool(has[0] & has[1])


_SCORE: Final = "{:.3f}"
_SHARE: Final = "{:.1%}"
_ANSWER_COLUMNS: Final[Columns] = {
    "pdms": ("PDMS", _SCORE),
    "draws_pdms": ("of all draws", _SCORE),
    "epdms": ("EPDMS", _SCORE),
    "longitudinal": ("speed right", _SHARE),
    "lateral": ("direction right", _SHARE),
    "both": ("both right", _SHARE),
}
_REFINE_COLUMNS: Final[Columns] = {
    "failed": ("fails", _SHARE),
    "noticed": ("noticed", _SHARE),
    "before": ("before", _SCORE),
    "after": ("after", _SCORE),
    "again": ("drawn once more", _SCORE),
    "refined_pdms": ("PDMS, refined where noticed", _SCORE),
}
_THRESHOLD_COLUMNS: Final[Columns] = {each: _ANSWER_COLUMNS[each] for each in ("pdms", "epdms", "both")}
