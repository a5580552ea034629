"""`looktwice train ladder`: the whole of CF-VLA's ladder, from scenes to the table, in one command."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import typer

from looktwice.model.evaluation.ladder import COUNTERFACTUAL, META_ACT, MULTI_ROUND, ROUND_2, WHOLE_DATASET
from looktwice.service.cli.serving import served

_LOOKTWICE: Final = (sys.executable, "-m", "looktwice.service.cli")
_CHECKPOINT_FILE: Final = "looktwice.json"


@dataclass(frozen=True)
class LadderEntry:
    """One checkpoint of the ladder.

    Attributes:
        name: its folder.
        recipe: that makes it.
        source: the entry that it is trained from.
        build: the build whose reflections it learns from; empty below them.
        vision: the entry whose vision tower it takes; empty for that of its source.
    """

    name: str
    recipe: str
    source: str
    build: str = ""
    vision: str = ""


@dataclass(frozen=True)
class Build:
    """A data set of the ladder: which entry is rolled out, what is kept to be labelled, what is added to be
    acted on."""

    name: str
    entry: str
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
    LadderEntry("tracks", "read-tracks", _UNTRAINED),
    LadderEntry("language", "language", "tracks"),
    LadderEntry("ground", "ground", _UNTRAINED),
    LadderEntry("scene", "read-scene", "language", vision="ground"),
    LadderEntry(META_ACT, "meta-act", "scene"),
)
_OF_RECIPES: Final = frozenset(("--learning-rate", "--vision-rate"))
"""Options that are meant for the entries above `META_ACT`: below it every recipe has its own."""
_LADDER: Final = (
    LadderEntry(COUNTERFACTUAL, "counterfactual", META_ACT, "round-1"),
    LadderEntry(MULTI_ROUND, "multi-round", META_ACT, "round-1"),
    LadderEntry(WHOLE_DATASET, "counterfactual", META_ACT, "whole"),
    LadderEntry(ROUND_2, "counterfactual", COUNTERFACTUAL, "round-2"),
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
        training: options of `looktwice train` for every entry, in pairs or alone.
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
        for entry in _GROUNDWORK:
            vision = ["--vision-from", str(folder / entry.vision)] if entry.vision else []
            _train(entry, folder, scenes, [*vision, *own], processes)
    for entry in _LADDER:
        reflections = folder / f"{entry.build}.parquet"
        if not reflections.exists() and not _is_there(folder / entry.name):
            _make(_BUILDS[entry.build], folder, scenes, every, reflections)
        _train(entry, folder, scenes, ["--reflections", str(reflections), *training], processes)
    _run(
        _LOOKTWICE,
        ["evaluate", "--preset", "ladder", "--checkpoint", str(folder / COUNTERFACTUAL)],
        ["--ladder", str(folder), "--scenes", str(test), "--plots", str(folder / "plots")],
        ["--think-threshold", _THINK_THRESHOLD, "--keep", str(folder / "draws.sqlite")],
    )


def _is_there(checkpoint: Path) -> bool:
    return (checkpoint / _CHECKPOINT_FILE).exists()


def _train(entry: LadderEntry, folder: Path, scenes: Path, options: Sequence[str], processes: int) -> None:
    """Train one entry, unless it is there."""
    if _is_there(folder / entry.name):
        return
    _run(
        [sys.executable, "-m", "torch.distributed.run", "--standalone"],
        ["--nproc-per-node", str(processes), "-m", "looktwice.service.cli", "train", entry.recipe],
        ["--from", str(folder / entry.source), "--to", str(folder / entry.name)],
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
    options = ["--checkpoint", str(folder / build.entry), "--rows", str(_ROWS)]
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
