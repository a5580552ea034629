"""Second looks by what comes of them: plans are followed, and either hold or fail
(`looktwice.model.driving.outcome`).

Two runs over the same scenes are compared draw by draw: one never thinks, one thinks where it chooses to. A
draw's random numbers depend on seed, draw and position alone, so both begin with the same first plan, and the
run that never thinks shows what the first plan leads to.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, get_args

import numpy as np

from looktwice.model.driving.columns import aligned
from looktwice.model.driving.intervals import Array, Interval, episode_weights, interval_of, ratio_interval
from looktwice.model.driving.outcome import FailureName, Outcome

FAILURES: tuple[FailureName, ...] = get_args(FailureName)


@dataclass(frozen=True)
class FollowedDraw:
    """One draw of both runs.

    Attributes:
        episode_id: of its scene.
        think_probability: of a second look at its first plan.
        first: what came of the first plan.
        thought: whether the run that may think looked a second time.
        last: what came of the plan that it then went by; ``first`` where it did not look.
    """

    episode_id: str
    think_probability: float
    first: Outcome
    thought: bool
    last: Outcome


@dataclass(frozen=True)
class Figure:
    """A share or an area, with its 95 % interval over episodes; all None where there is nothing to count."""

    value: float | None
    interval: Interval | None
    count: int


@dataclass(frozen=True)
class OutcomeTable:
    """What second looks bring, in some scenes with the same inputs.

    Attributes:
        scenes: that count; those where the expert's own way fails do not.
        expert_fails: how many of those there were.
        unpaired: draws that are left out, because the two runs did not begin with the same plan.
        think_outcome_auc: area under the curve of the think probability against "the first plan fails".
        think_rate: share of draws that took a second look.
        revised_better, revised_worse: of the looks taken, how many led to an outcome of a higher rank, or of
            a lower one (`Outcome.rank`). The rest changed nothing that counts.
        rates: by run (``never``, ``adaptive``), the share of draws that hold, and that fail at each thing.
    """

    scenes: int
    expert_fails: int
    unpaired: int
    think_outcome_auc: Figure
    think_rate: Figure
    revised_better: Figure
    revised_worse: Figure
    rates: Mapping[str, Mapping[str, Figure]]

    def to_json(self) -> dict[str, Any]:
        """For scripts."""
        told: dict[str, Any] = {
            "scenes": self.scenes,
            "expert_fails": self.expert_fails,
            "unpaired": self.unpaired,
        }
        for name, figure in (
            ("think_outcome_auc", self.think_outcome_auc),
            ("think_rate", self.think_rate),
            ("revised_better_by_outcome", self.revised_better),
            ("revised_worse_by_outcome", self.revised_worse),
        ):
            told |= {name: figure.value, f"{name}_interval": figure.interval, f"{name}_count": figure.count}
        told["outcomes"] = {
            run: {name: asdict(figure) for name, figure in of.items()} for run, of in self.rates.items()
        }
        return told

    def __str__(self) -> str:
        lines = [
            f"{self.scenes} scenes; {self.expert_fails} more in which the expert's own way fails; "
            f"{self.unpaired} draws left out",
            f"think probability against a first plan that fails, AUC: {_told(self.think_outcome_auc)}",
            f"second looks taken: {_told(self.think_rate)}",
            f"  better by outcome: {_told(self.revised_better)}",
            f"  worse by outcome:  {_told(self.revised_worse)}",
        ]
        table = [["share of draws", *self.rates]]
        for name in ("holds", *FAILURES):
            table.append(["  " + name.replace("_", " "), *(_told(of[name]) for of in self.rates.values())])
        return "\n".join([*lines, *aligned(table)])


def outcome_table(
    draws: Sequence[FollowedDraw], scenes: int, expert_fails: int = 0, unpaired: int = 0
) -> OutcomeTable:
    """The table of some draws of so many scenes; see `OutcomeTable`."""
    looks = [draw for draw in draws if draw.thought]
    rates = {
        "never": _rates(draws, lambda draw: draw.first),
        "adaptive": _rates(draws, lambda draw: draw.last),
    }
    return OutcomeTable(
        scenes,
        expert_fails,
        unpaired,
        _area(draws),
        _share(draws, lambda draw: draw.thought),
        _share(looks, lambda draw: draw.last.rank > draw.first.rank),
        _share(looks, lambda draw: draw.last.rank < draw.first.rank),
        rates,
    )


def _rates(draws: Sequence[FollowedDraw], of: Callable[[FollowedDraw], Outcome]) -> dict[str, Figure]:
    """The share of draws that hold in one of the runs, and that fail at each thing."""

    def failing(name: FailureName) -> Figure:
        return _share(draws, lambda draw: name in of(draw).fails)

    return {"holds": _share(draws, lambda draw: of(draw).holds)} | {name: failing(name) for name in FAILURES}


def _share(draws: Sequence[FollowedDraw], is_so: Callable[[FollowedDraw], bool]) -> Figure:
    if not draws:
        return Figure(None, None, 0)
    place = _places(draws)
    so = np.array([float(is_so(draw)) for draw in draws])
    amounts, by = (np.bincount(place, each).astype(np.float64) for each in (so, np.ones(len(so))))
    return Figure(float(so.mean()), ratio_interval(amounts, by), len(draws))


def _area(draws: Sequence[FollowedDraw]) -> Figure:
    """Area under the curve: how often a failing plan has a higher think probability than one that holds."""
    place, fails = _places(draws), np.array([not draw.first.holds for draw in draws], bool)
    if fails.all() or not fails.any():
        return Figure(None, None, len(draws))
    scores = np.array([draw.think_probability for draw in draws])
    episodes = int(place.max()) + 1
    # Pairs by the episodes of both, so that resampled episodes only weigh them.
    higher = np.zeros((episodes, episodes))
    for score, episode in zip(scores[fails], place[fails], strict=True):
        won = (score > scores[~fails]) + 0.5 * (score == scores[~fails])
        higher[episode] += np.bincount(place[~fails], won, episodes)
    failing, holding = (
        np.bincount(place[each], minlength=episodes).astype(np.float64) for each in (fails, ~fails)
    )
    weights = episode_weights(episodes)
    pairs: Array = (weights @ failing) * (weights @ holding)
    won_pairs = np.einsum("re,ef,rf->r", weights, higher, weights, optimize=True)
    value = float(higher.sum() / (failing.sum() * holding.sum()))
    return Figure(value, interval_of(won_pairs[pairs > 0] / pairs[pairs > 0]), len(draws))


def _places(draws: Sequence[FollowedDraw]) -> Any:
    """The episode of each draw, as a number."""
    episodes = {name: place for place, name in enumerate(sorted({draw.episode_id for draw in draws}))}
    return np.array([episodes[draw.episode_id] for draw in draws], np.int64)


def _told(figure: Figure) -> str:
    if figure.value is None or figure.interval is None:
        return "-"
    low, high = figure.interval
    return f"{figure.value:.3f} [{low:.3f}, {high:.3f}] of {figure.count}"
