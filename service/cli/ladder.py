"""`looktwice train ladder`: the whole of CF-VLA's ladder, from scenes to the table, in one command."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import typer

from looktwice.model.evaluation.ladder import COUNTERFACTUAL, META_ACT, MULTI_ROUND, ROUND_2, WHOLE_DATASET
from looktwice.service.cli.serving import served

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


@dataclass(frozen=True)
class Step:
    """A command of the ladder.

    Attributes:
        words: that `looktwice` is called with.
        processes: that run it together; 0: it is called without `torch.distributed.run`.
        served: the checkpoint that a service plans with meanwhile; its URL is the command's ``--service``.
    """

    words: tuple[str, ...]
    processes: int = 0
    served: Path | None = None


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
    for step in steps_left(folder, scenes, test, training, every=every, processes=processes):
        follow(step)


def steps_left(
    folder: Path, scenes: Path, test: Path, training: Sequence[str], *, every: int, processes: int
) -> list[Step]:
    """What is still to be done, in order; arguments as of `climb`."""
    steps: list[Step] = []
    if not _is_there(folder / META_ACT):
        if not _is_there(folder / _UNTRAINED):
            to = ("--to", str(folder / _UNTRAINED))
            steps.append(Step(("train", "create", *to, "--scenes", str(scenes), *training)))
        own = _without(training, _OF_RECIPES)
        for entry in _GROUNDWORK:
            vision = ["--vision-from", str(folder / entry.vision)] if entry.vision else []
            steps += _trained(entry, folder, scenes, [*vision, *own], processes)
    built = set[str]()
    for entry in _LADDER:
        reflections = folder / f"{entry.build}.parquet"
        wanted = not reflections.exists() and not _is_there(folder / entry.name)
        if wanted and entry.build not in built:
            built.add(entry.build)
            steps += _built(_BUILDS[entry.build], folder, scenes, every, reflections)
        steps += _trained(entry, folder, scenes, ["--reflections", str(reflections), *training], processes)
    table = ("evaluate", "--preset", "ladder", "--checkpoint", str(folder / COUNTERFACTUAL))
    kept = ("--plots", str(folder / "plots"), "--keep", str(folder / "draws.sqlite"))
    of = ("--ladder", str(folder), "--scenes", str(test), "--think-threshold", _THINK_THRESHOLD)
    return [*steps, Step((*table, *of, *kept))]


def follow(step: Step, call: Callable[[Sequence[str]], int] = subprocess.call) -> None:
    """Run a step's command; raises RuntimeError when it fails.

    Args:
        step: of `steps_left`.
        call: runs a command and says with which code it ended.
    """
    with ExitStack() as meanwhile:
        words = step.words
        if step.served is not None:
            # Nobody waits for an answer here: the more at once the better.
            options = ["--checkpoint", str(step.served), "--rows", str(_ROWS)]
            _, url = meanwhile.enter_context(served(options, {"LOOKTWICE_MAX_DRAWS": str(_ROWS)}))
            words = (*words, "--service", url)
        together = (
            ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(step.processes))
            if step.processes
            else ()
        )
        command = (sys.executable, *together, "-m", "looktwice.service.cli", *words)
        typer.echo(f"$ {' '.join(command)}", err=True)
        if code := call(command):
            raise RuntimeError(f"{' '.join(command)} ended with code {code}")


def _is_there(checkpoint: Path) -> bool:
    return (checkpoint / _CHECKPOINT_FILE).exists()


def _trained(
    entry: LadderEntry, folder: Path, scenes: Path, options: Sequence[str], processes: int
) -> list[Step]:
    """The step that trains an entry; none where it is there."""
    if _is_there(folder / entry.name):
        return []
    between = ("--from", str(folder / entry.source), "--to", str(folder / entry.name))
    words = ("train", entry.recipe, *between, "--scenes", str(scenes), *options)
    return [Step(words, processes)]


def _without(options: Sequence[str], names: frozenset[str]) -> list[str]:
    """Options without some that have values."""
    places = [place for place, option in enumerate(options) if option in names]
    return [option for at, option in enumerate(options) if not {at, at - 1} & set(places)]


def _built(build: Build, folder: Path, scenes: Path, every: int, reflections: Path) -> list[Step]:
    """Everything from a checkpoint to a file of reflections on its plans."""
    place = str(folder / f"build-{build.name}")
    return [
        Step(("build", "rollout", place, str(scenes), "--every", str(every)), served=folder / build.entry),
        Step(("build", "filter", place, *build.keep)),
        Step(("build", "label", place, str(scenes), "--plans-per-scene", str(_PLANS_PER_SCENE))),
        Step(("build", "export", place, "--to", str(reflections), *build.right)),
    ]
