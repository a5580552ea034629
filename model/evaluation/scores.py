"""NAVSIM's scores of planners over labelled scenes: a row a planner, with intervals over episodes."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np

from looktwice.model.driving.columns import aligned, cell, interval_cell
from looktwice.model.driving.intervals import Interval, ratio_interval
from looktwice.model.driving.pdm.comfort import Version
from looktwice.model.driving.pdm.judging import SceneJudge
from looktwice.model.driving.pdm.labelled import moment_before, plans_of, states_of
from looktwice.model.driving.pdm.scoring import (
    COLLISIONS,
    COMFORT,
    DIRECTION,
    DRIVABLE,
    EXTENDED_COMFORT,
    FACTORS,
    LANE_KEEPING,
    LIGHTS,
    PROGRESS,
    TIME_TO_COLLISION,
    WEIGHTS,
)
from looktwice.model.driving.pdm.world import Array
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.evaluation.open_loop import BASELINES, EXPERT

VERSIONS: Final[Mapping[Version, str]] = {"v1.1": "PDMS", "v2.2": "EPDMS"}
BEFORE_S: Final = 0.5
"""Extended comfort compares a plan with the one made so much earlier."""
_TITLES: Final = {
    COLLISIONS: "collisions",
    DRIVABLE: "drivable",
    DIRECTION: "direction",
    LIGHTS: "lights",
    PROGRESS: "progress",
    TIME_TO_COLLISION: "TTC",
    LANE_KEEPING: "lane",
    COMFORT: "comfort",
    EXTENDED_COMFORT: "extended",
}
_STEP: Final = re.compile(r"-(\d{4})$")


@dataclass(frozen=True)
class SceneScore:
    """What one trajectory is worth in one scene, by the rules of one version.

    Attributes:
        scene_id, episode_id: the scene's own.
        sub_scores: by name; None where what it needs is not known.
        score: None where a sub-score is.
        partial_score: of the sub-scores that are there; None where none is.
    """

    scene_id: str
    episode_id: str
    sub_scores: Mapping[str, float | None]
    score: float | None
    partial_score: float | None

    @classmethod
    def mean(cls, scores: Sequence[Self]) -> Self:
        """The mean of several trajectories of one scene; what is not known of one, is not known."""
        first = scores[0]
        return cls(
            first.scene_id,
            first.episode_id,
            {name: mean_of([each.sub_scores[name] for each in scores]) for name in first.sub_scores},
            mean_of([each.score for each in scores]),
            mean_of([each.partial_score for each in scores]),
        )


def mean_of(values: Sequence[float | None]) -> float | None:
    """Their mean; None where one of them is not known, or there are none."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None


@dataclass(frozen=True)
class ScoreRow:
    """Means of one planner over scenes by one version's rules, with 95 % intervals over episodes.

    Attributes:
        name: the planner's.
        version: whose rules.
        scenes, episodes: how many.
        score: None where a sub-score is missing in some scene.
        partial_score: of the sub-scores that are there, in every scene.
        sub_scores: over the scenes that have them; None where none has.
        missing: in how many scenes a sub-score is missing, of those that are.
        intervals: of ``score``, ``partial_score`` and the sub-scores, where they are there.
    """

    name: str
    version: Version
    scenes: int
    episodes: int
    score: float | None
    partial_score: float | None
    sub_scores: Mapping[str, float | None]
    missing: Mapping[str, int]
    intervals: Mapping[str, Interval]

    @classmethod
    def of(cls, name: str, version: Version, scores: Sequence[SceneScore]) -> ScoreRow:
        """The row of a planner's scores; raises ValueError without any."""
        if not scores:
            raise ValueError(f"{name}: there are no scenes to score")
        names = (*FACTORS[version], *WEIGHTS[version])
        measured: dict[str, list[float | None]] = {
            "score": [each.score for each in scores],
            "partial_score": [each.partial_score for each in scores],
            **{each: [scene.sub_scores[each] for scene in scores] for each in names},
        }
        if None in measured["score"]:
            # The mean of those scenes alone that happen to be complete would be one of other scenes.
            measured["score"] = [None] * len(scores)
        episodes = [each.episode_id for each in scores]
        found = {each: _mean(episodes, values) for each, values in measured.items()}
        return cls(
            name,
            version,
            len(scores),
            len(set(episodes)),
            _value(found["score"]),
            _value(found["partial_score"]),
            {each: _value(found[each]) for each in names},
            {each: lacking for each in names if (lacking := measured[each].count(None))},
            {each: of[1] for each, of in found.items() if of is not None},
        )

    def to_json(self) -> dict[str, Any]:
        """The row as JSON's values."""
        return {
            "name": self.name,
            "scenes": self.scenes,
            "episodes": self.episodes,
            "score": self.score,
            "partial_score": self.partial_score,
            "sub_scores": dict(self.sub_scores),
            "missing": dict(self.missing),
            "intervals": {name: list(interval) for name, interval in self.intervals.items()},
        }


@dataclass(frozen=True)
class ScoreTable:
    """Rows of all planners, by version.

    Attributes:
        rows: of each version.
        forgiven: whether what the expert fails at too is forgiven.
        without_lights: scenes of worlds that have no traffic lights, where none can be red.
    """

    rows: Mapping[Version, tuple[ScoreRow, ...]]
    forgiven: bool
    without_lights: int

    def to_json(self) -> dict[str, Any]:
        """``pdms`` and ``epdms`` hold the rows; progress is ``against`` the expert."""
        first = next(iter(self.rows.values()))[0]
        return {
            "scenes": first.scenes,
            "episodes": first.episodes,
            "against": EXPERT,
            "forgiven": self.forgiven,
            "scenes_without_lights": self.without_lights,
            **{VERSIONS[of].lower(): [row.to_json() for row in rows] for of, rows in self.rows.items()},
        }

    def __str__(self) -> str:
        lines = []
        for version, rows in self.rows.items():
            names = (*FACTORS[version], *WEIGHTS[version])
            title = f"{VERSIONS[version]} ({version})"
            header = [title, "scenes", "score", "95 %", *(_TITLES[name] for name in names)]
            lines += [*aligned([header, *(_cells(row, names) for row in rows)])]
            lines += [f"* {row.name} is partial: {_lacks(row)}" for row in rows if row.missing]
            lines.append("")
        lines.append(f"Progress is measured against the {EXPERT}'s.")
        if self.without_lights:
            lines.append(f"{self.without_lights} scenes are of a world without traffic lights: lights is 1.")
        if self.forgiven:
            lines.append(f"What the {EXPERT} fails at too is forgiven ({VERSIONS['v2.2']}).")
        return "\n".join(lines)


Planner = Callable[[LabelledScene], tuple[FloatArray, Array | None]]
"""A trajectory [8 or 64, 4], and simulated states [41, 11] of the one made `BEFORE_S` before, if known."""


def expert_path(labelled: LabelledScene) -> tuple[FloatArray, Array | None]:
    """The expert as a planner: half a second ago it was to drive as it did."""
    history, future = moment_before(labelled, BEFORE_S)
    return labelled.future, states_of(history, plans_of(future))


def by_rule(baseline: Callable[[FloatArray], FloatArray]) -> Planner:
    """A kinematic baseline as a planner."""

    def plan(labelled: LabelledScene) -> tuple[FloatArray, Array | None]:
        history, _ = moment_before(labelled, BEFORE_S)
        return baseline(labelled.scene.history), states_of(history, plans_of(baseline(history)))

    return plan


def by_scene(scenes: Sequence[LabelledScene], trajectories: Mapping[str, FloatArray]) -> Planner:
    """A planner whose trajectories [8 or 64, 4] are known by scene id.

    What it planned before is its trajectory of the scene that lies `BEFORE_S` back in the same episode, told
    by the step in generated scenes' names.
    """
    named = {each.scene.scene_id: each for each in scenes}

    def plan(labelled: LabelledScene) -> tuple[FloatArray, Array | None]:
        before = named.get(_name_before(labelled.scene.scene_id))
        if before is None or before.episode_id != labelled.episode_id:
            return trajectories[labelled.scene.scene_id], None
        planned = trajectories[before.scene.scene_id]
        return trajectories[labelled.scene.scene_id], states_of(before.scene.history, plans_of(planned))

    return plan


def score_table(
    scenes: Sequence[LabelledScene], planners: Mapping[str, Planner], *, forgive: bool = False
) -> ScoreTable:
    """Score the expert, the kinematic baselines and more planners in every scene, by both versions' rules.

    Args:
        scenes: at least one.
        planners: by the names of their rows.
        forgive: as NAVSIM's EPDMS does, forgive what the expert fails at too.

    Raises:
        ValueError: no scenes.
        ScoreError, SolveError: see `looktwice.model.driving.pdm.scoring.score`.
    """
    judges = [SceneJudge(each) for each in scenes]
    every = {**baseline_planners(), **planners}
    found = {name: scene_scores(judges, planner, forgive=forgive) for name, planner in every.items()}
    return table_of(judges, found, forgiven=forgive)


def baseline_planners() -> dict[str, Planner]:
    """The expert and the kinematic baselines."""
    return {EXPERT: expert_path} | {name: by_rule(baseline) for name, baseline in BASELINES.items()}


def scene_scores(
    judges: Sequence[SceneJudge], planner: Planner, *, forgive: bool = False
) -> dict[Version, list[SceneScore]]:
    """What a planner is worth in every scene, by both versions' rules; see `score_table`."""
    found: dict[Version, list[SceneScore]] = {version: [] for version in VERSIONS}
    for judge in judges:
        trajectory, before = planner(judge.labelled)
        plan = plans_of(trajectory)[None]
        for version, results in found.items():
            scores = judge.scores(plan, version, previous=before, forgive=forgive)
            subs = {
                name: None if values is None else _known(values[0])
                for name, values in scores.sub_scores.items()
            }
            whole, partial = _known(scores.score[0]), _known(scores.partial_score[0])
            about = judge.labelled.scene.scene_id, judge.labelled.episode_id
            results.append(SceneScore(*about, subs, whole, partial))
    return found


def table_of(
    judges: Sequence[SceneJudge],
    found: Mapping[str, Mapping[Version, Sequence[SceneScore]]],
    *,
    forgiven: bool = False,
) -> ScoreTable:
    """The table of planners' scores in the scenes of ``judges``; raises ValueError without scenes."""
    rows = {
        version: tuple(ScoreRow.of(name, version, of[version]) for name, of in found.items())
        for version in VERSIONS
    }
    known = [lane_map for judge in judges if (lane_map := judge.labelled.lane_map) is not None]
    return ScoreTable(rows, forgiven, sum(not lane_map.has_lights for lane_map in known))


def _known(value: float) -> float | None:
    return None if np.isnan(value) else float(value)


def _name_before(scene_id: str) -> str:
    """The generator's name of the scene `BEFORE_S` earlier; "" where the name tells no step."""
    told = _STEP.search(scene_id)
    if told is None:
        return ""
    return f"{scene_id[: told.start()]}-{int(told[1]) - round(BEFORE_S * 10):04d}"


def _mean(episodes: Sequence[str], values: Sequence[float | None]) -> tuple[float, Interval] | None:
    """Mean and interval of what is there."""
    sums: dict[str, list[float]] = {}
    for episode, value in zip(episodes, values, strict=True):
        if value is not None:
            sums.setdefault(episode, []).append(value)
    if not sums:
        return None
    amounts = np.array([sum(of) for of in sums.values()])
    counts = np.array([float(len(of)) for of in sums.values()])
    return float(amounts.sum() / counts.sum()), ratio_interval(amounts, counts)


def _value(found: tuple[float, Interval] | None) -> float | None:
    return None if found is None else found[0]


def _cells(row: ScoreRow, names: Sequence[str]) -> list[str]:
    shown, mark = ("partial_score", "*") if row.score is None else ("score", "")
    return [
        row.name,
        str(row.scenes),
        cell(getattr(row, shown), "{:.3f}" + mark),
        interval_cell(row.intervals.get(shown), "{:.3f}"),
        *(cell(row.sub_scores[name], "{:.3f}") for name in names),
    ]


def _lacks(row: ScoreRow) -> str:
    return ", ".join(f"{name} is missing in {count} scenes" for name, count in row.missing.items())
