"""`looktwice train ladder`: the whole of CF-VLA's ladder, from scenes to the table, in one command."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import typer

from model.evaluation.ladder import COUNTERFACTUAL, META_ACT, MULTI_ROUND, ROUND_2, WHOLE_DATASET
from service.cli.serving import served

_LOOKTWICE: Final = (sys.executable, "-m", "service.cli")
_CHECKPOINT_FILE: Final = "looktwice.json"


@dataclass(frozen=True)
class Rung:
    """One checkpoint of the ladder.

    Attributes:
        name: its folder.
        recipe: that makes it.
        source: the rung that it is trained from.
        build: the build whose reflections it learns from; empty below them.
        vision: the rung whose vision tower it takes; empty for that of its source.
    """

    name: str
    recipe: str
    source: str
    build: str = ""
    vision: str = ""


@dataclass(frozen=True)
class Build:
    """A data set of the ladder: which rung is rolled out, what is kept to be labelled, what is added to be
    acted on."""

    name: str
    rung: str
    keep: tuple[str, ...]
    right: tuple[str, ...] = ()


_KEEP: Final = ("--epsilon", "1", "--gain", "0.25", "--plan-iou", "0.5")
_RIGHT: Final = ("--right-iou", "0.7")
_BUILDS: Final = {
    build.name: build
    for build in (
        Build("round-1", META_ACT, _KEEP, _RIGHT),
        Build("whole", META_ACT, ("--everything",)),
        Build("round-2", COUNTERFACTUAL, _KEEP, _RIGHT),
    )
}
_UNTRAINED: Final = "untrained"
_GROUNDWORK: Final = (
    Rung("tracks", "read-tracks", _UNTRAINED),
    Rung("language", "language", "tracks"),
    Rung("ground", "ground", _UNTRAINED),
    Rung("scene", "read-scene", "language", vision="ground"),
    Rung(META_ACT, "meta-act", "scene"),
)
_OF_RECIPES: Final = frozenset(("--learning-rate", "--vision-rate"))
"""Options that are meant for the rungs above `META_ACT`: below it every recipe has its own."""
_RUNGS: Final = (
    Rung(COUNTERFACTUAL, "counterfactual", META_ACT, "round-1"),
    Rung(MULTI_ROUND, "multi-round", META_ACT, "round-1"),
    Rung(WHOLE_DATASET, "counterfactual", META_ACT, "whole"),
    Rung(ROUND_2, "counterfactual", COUNTERFACTUAL, "round-2"),
)
_PLANS_PER_SCENE: Final = 6
_ROWS: Final = 96
_THINK_THRESHOLD: Final = "0.25"
"""Chosen on validation scenes (docs/results.md)."""


def climb(
    folder: Path,
    scenes: Path,
    test: Path,
    meta_act: Path | None,
    training: Sequence[str],
    *,
    every: int,
    processes: int,
) -> None:
    """Train up to meta-actions, then roll out, label and train round by round, then print the table.

    Started again, it goes on.

    Args:
        folder: where builds, checkpoints and plots go.
        scenes, test: to train on and to test on.
        meta_act: a checkpoint that writes meta-actions, to begin with; None to train that as well.
        training: options of `looktwice train` for every rung, in pairs or alone.
        every: so many-th scene is rolled out.
        processes: that train together.

    Raises:
        RuntimeError: a step failed; what is done is kept.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if meta_act is not None and not (folder / META_ACT).exists():
        (folder / META_ACT).symlink_to(meta_act.resolve(), target_is_directory=True)
    if not _is_there(folder / META_ACT):
        if not _is_there(folder / _UNTRAINED):
            _run(
                _LOOKTWICE,
                ["train", "create", "--to", str(folder / _UNTRAINED), "--scenes", str(scenes), *training],
            )
        own = _without(training, _OF_RECIPES)
        for rung in _GROUNDWORK:
            vision = ["--vision-from", str(folder / rung.vision)] if rung.vision else []
            _train(rung, folder, scenes, [*vision, *own], processes)
    for rung in _RUNGS:
        reflections = folder / f"{rung.build}.parquet"
        if not reflections.exists() and not _is_there(folder / rung.name):
            _make(_BUILDS[rung.build], folder, scenes, every, reflections)
        _train(rung, folder, scenes, ["--reflections", str(reflections), *training], processes)
    _run(
        _LOOKTWICE,
        ["evaluate", "--preset", "ladder", "--checkpoint", str(folder / COUNTERFACTUAL)],
        ["--ladder", str(folder), "--scenes", str(test), "--plots", str(folder / "plots")],
        ["--think-threshold", _THINK_THRESHOLD, "--keep", str(folder / "draws.sqlite")],
    )


def _is_there(checkpoint: Path) -> bool:
    return (checkpoint / _CHECKPOINT_FILE).exists()


def _train(rung: Rung, folder: Path, scenes: Path, options: Sequence[str], processes: int) -> None:
    """Train one rung, unless it is there."""
    if _is_there(folder / rung.name):
        return
    _run(
        [sys.executable, "-m", "torch.distributed.run", "--standalone"],
        ["--nproc-per-node", str(processes), "-m", "service.cli", "train", rung.recipe],
        ["--from", str(folder / rung.source), "--to", str(folder / rung.name)],
        ["--scenes", str(scenes), *options],
    )


def _without(options: Sequence[str], names: frozenset[str]) -> list[str]:
    """Options without some that have values."""
    places = [place for place, option in enumerate(options) if option in names]
    return [option for at, option in enumerate(options) if not {at, at - 1} & set(places)]


def _make(build: Build, folder: Path, scenes: Path, every: int, reflections: Path) -> None:
    """Everything from a checkpoint to a file of reflections on its plans."""
    place = str(folder / f"build-{build.name}")
    # Nobody waits for an answer here: the more at once the better.
    options = ["--checkpoint", str(folder / build.rung), "--rows", str(_ROWS)]
    with served(options, {"LOOKTWICE_MAX_DRAWS": str(_ROWS)}) as (_, url):
        _run(
            _LOOKTWICE,
            ["build", "rollout", place, str(scenes), "--service", url, "--every", str(every)],
        )
    _run(_LOOKTWICE, ["build", "filter", place, *build.keep])
    _run(_LOOKTWICE, ["build", "label", place, str(scenes), "--plans-per-scene", str(_PLANS_PER_SCENE)])
    _run(_LOOKTWICE, ["build", "export", place, "--to", str(reflections), *build.right])


def _run(*parts: Sequence[str]) -> None:
    """Run a command; raises RuntimeError when it fails."""
    command = [word for part in parts for word in part]
    typer.echo(f"$ {' '.join(command)}", err=True)
    ended = subprocess.run(command, check=False)
    if ended.returncode:
        raise RuntimeError(f"{' '.join(command)} ended with code {ended.returncode}")
