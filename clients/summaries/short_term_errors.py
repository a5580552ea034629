"""How far off half a second ahead is predicted on labelled scenes: `looktwice.model.driving.short_term`."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.agents import ROAD_USERS
from looktwice.model.driving.scene_store import SceneFileError, count_scenes, read_scenes
from looktwice.model.driving.short_term import (
    AHEAD_ROW,
    INERTIA,
    MissionGoal,
    ShortTermPredictor,
    agent_errors,
    ego_error,
    fit_short_term,
    mission_goal,
)
from looktwice.model.driving.trajectory import constant_turn_rate, constant_velocity

_BASELINES: Final = {"constant_velocity": constant_velocity, "constant_turn_rate": constant_turn_rate}
_GOALS: Final[tuple[MissionGoal, ...]] = ("left", "forward", "right")
_NAMES: Final = {
    "fitted": "ego, lambda fitted",
    "lambda_0": "ego, lambda = 0",
    "lambda_1": "ego, lambda = 1",
    "constant_velocity": "ego, constant velocity",
    "constant_turn_rate": "ego, constant turn rate",
}


def short_term_figures(train: Path, validation: Path) -> dict[str, Any]:
    """Fit the predictor on the scenes at ``train``, and measure it on those at ``validation``.

    ``lambda`` has the weight of each mission goal, None where too few scenes have it and momentum decides.
    ``ego_m`` has mean distances to the expert in metres: with these weights (``fitted``), of momentum alone
    (``lambda_0``), of the goal's ideal step alone (``lambda_1``), and of two baselines. ``agents`` has the
    same of road users by momentum, how many were ``predicted``, and how many are ``new``: there now and half
    a second later, but not half a second before.

    Raises:
        SceneFileError: a path holds no labelled scenes.
        ShortTermError: no mission goal has enough scenes.
    """
    fitted = fit_short_term(read_scenes(train, dense=False))
    predictors = {
        "fitted": fitted,
        "lambda_0": INERTIA,
        "lambda_1": ShortTermPredictor(
            {goal: replace(fit, weight=1.0) for goal, fit in fitted.goals.items()}
        ),
    }
    ego_m = defaultdict[str, list[float]](list)
    agents_m = defaultdict[str, list[float]](list)
    for labelled in read_scenes(validation, dense=False):
        history, route = labelled.scene.history, labelled.scene.route
        goal = None if route is None else mission_goal(route)
        for name, predictor in predictors.items():
            ego_m[name].append(ego_error(predictor.ego(history, goal), labelled))
        for name, baseline in _BASELINES.items():
            ego_m[name].append(ego_error(baseline(history)[AHEAD_ROW], labelled))
        there = [
            agent for agent in labelled.agents if np.isfinite([agent.present, agent.future[AHEAD_ROW]]).all()
        ]
        for agent, error in zip(there, agent_errors(INERTIA, there), strict=True):
            agents_m[agent.kind].append(float(error))
    if not ego_m:
        raise SceneFileError(f"{validation} holds no scenes")
    return {
        "train_scenes": count_scenes(train),
        "scenes": len(ego_m["fitted"]),
        "lambda": {goal: fitted.goals[goal].weight if goal in fitted.goals else None for goal in _GOALS},
        "ego_m": {name: float(np.mean(errors)) for name, errors in ego_m.items()},
        "agents": {kind: _agents(np.array(agents_m[kind])) for kind in ROAD_USERS if agents_m[kind]},
    }


def _agents(errors_m: npt.NDArray[np.float64]) -> dict[str, Any]:
    """Of a kind's errors [n] in metres, NaN where nothing was predicted."""
    known = errors_m[np.isfinite(errors_m)]
    mean_m = float(known.mean()) if len(known) else None
    return {"mean_m": mean_m, "predicted": len(known), "new": len(errors_m) - len(known)}


def format_short_term(figures: dict[str, Any]) -> str:
    """`short_term_figures` as a table for people."""
    fitted = ", ".join(
        f"{goal} {'unknown' if weight is None else format(weight, '.3f')}"
        for goal, weight in figures["lambda"].items()
    )
    lines = [
        f"lambda, fitted on {figures['train_scenes']} scenes: {fitted}",
        f"mean distance after half a second in {figures['scenes']} scenes",
        *(f"  {_NAMES[name]:28} {mean_m:.3f} m" for name, mean_m in figures["ego_m"].items()),
    ]
    for kind, found in figures["agents"].items():
        mean = "unknown" if found["mean_m"] is None else f"{found['mean_m']:.3f} m"
        lines.append(
            f"  {kind + ', lambda = 0':28} {mean}, {found['predicted']} predicted, {found['new']} new"
        )
    return "\n".join(lines)
