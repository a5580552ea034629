"""`looktwice evaluate --preset failures`: stages of learning from failures side by side."""

from __future__ import annotations

import asyncio
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from looktwice.service.cli.options import folder_along

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from looktwice.model.driving.scene import LabelledScene
    from looktwice.model.engines.engine import Controls, Engine
    from looktwice.model.evaluation.failures_report import FailuresReport


def stages_named(given: Sequence[str]) -> dict[str, Path]:
    """Checkpoints by the names of their stages, of ``NAME=FOLDER`` or ``FOLDER``, whose name is then its own.

    A folder may be the name of a checkpoint that comes along.

    Raises:
        ValueError: two have one name.
    """
    stages: dict[str, Path] = {}
    for each in given:
        before, equals, behind = each.partition("=")
        folder = Path(behind if equals else before)
        name = before if equals else folder.name
        if name in stages:
            raise ValueError(f"two stages are called {name!r}: name them as in --stage NAME=FOLDER")
        stages[name] = folder_along(folder)
    return stages


def evaluate_stages(
    scenes: Sequence[LabelledScene],
    engine_of: Callable[[Path], Engine],
    stages: Mapping[str, Path],
    controls: Controls,
    seeds: int,
    rows: int,
    *,
    quiet: bool,
) -> FailuresReport:
    """Evaluate stages one after the other on the same scenes."""
    from looktwice.model.driving.pdm.judging import SceneJudge
    from looktwice.model.evaluation.failures_report import failures_report
    from looktwice.model.evaluation.stage_results import evaluate_stage, stage_variants
    from looktwice.service.cli.evaluate import run_started

    judges = [SceneJudge(each) for each in scenes]
    # What one of them cannot do is refused before any of them plans.
    engines = {name: engine_of(folder) for name, folder in stages.items()}
    asked = {name: stage_variants(name, engine.card, controls, seeds) for name, engine in engines.items()}
    found = []
    for name, engine in engines.items():
        evaluate = partial(evaluate_stage, name=name, judges=judges)
        run = run_started(evaluate, scenes, engine, asked[name], controls.n, rows, quiet=quiet)
        found.append(asyncio.run(run))
    return failures_report(judges, found)
