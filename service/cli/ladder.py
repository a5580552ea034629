"""`looktwice train ladder`: the whole of CF-VLA's ladder, from scenes to the table, in one command."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Final

import typer

from looktwice.clients.metadrive.outcomes import Moment, redriver, setting_of
from looktwice.model.driving.scene_store import read_scenes, scene_files
from looktwice.model.evaluation.ladder import COUNTERFACTUAL, META_ACT, MULTI_ROUND, ROUND_2, WHOLE_DATASET
from looktwice.model.network.card import CARD_FILE
from looktwice.service.cli.serving import served


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
    """A data set of the ladder.

    Attributes:
        name: of its folder and its file.
        entry: whose plans it is made of.
        followed: whether its plans are followed in the simulator: those that fail are labelled, and those
            that hold are to be acted on. Otherwise all are labelled.
    """

    name: str
    entry: str
    followed: bool = True


@dataclass(frozen=True)
class LadderScenes:
    """Scenes of a ladder: files, or folders of them.

    Attributes:
        train, test: to train on, and for the table.
        roll_out: which of those to train on plans are made for; empty for all.
    """

    train: Path
    test: Path
    roll_out: tuple[Path, ...] = ()

    @property
    def planned_for(self) -> tuple[Path, ...]:
        """What is rolled out."""
        return self.roll_out or (self.train,)


_BUILDS: Final = {
    build.name: build
    for build in (
        Build("round-1", META_ACT),
        Build("whole", META_ACT, followed=False),
        Build("round-2", COUNTERFACTUAL),
    )
}
_UNTRAINED: Final = "untrained"
_GROUNDWORK: Final = (
    LadderEntry("tracks", "read-tracks", _UNTRAINED),
    LadderEntry("language", "language", "tracks"),
    LadderEntry("ground", "ground", _UNTRAINED),
    LadderEntry("facts", "read-facts", "ground"),
    LadderEntry("scene", "read-scene", "language", vision="facts"),
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
    scenes: LadderScenes,
    meta_act: Path | None,
    training: Sequence[str],
    *,
    every: int,
    processes: int,
    workers: int,
) -> None:
    """Train up to meta-actions, then build a data set of own plans and train, round by round, then print the
    table.

    Started again, it goes on.

    Args:
        folder: where builds, checkpoints and plots go.
        scenes: see there.
        meta_act: a checkpoint that writes meta-actions, to begin with; None to train that as well.
        training: options of `looktwice train` for every entry, in pairs or alone.
        every: so many-th scene is rolled out.
        processes: that train together.
        workers: processes that follow plans in the simulator.

    Raises:
        ValueError: ``meta_act`` is no checkpoint, or plans are to be followed in scenes where they cannot be
            (`worlds_of`); nothing is done.
        RuntimeError: a step failed; what is done is kept.
    """
    if meta_act is not None and not _is_there(meta_act):
        raise ValueError(f"{meta_act} holds no checkpoint to begin with: {CARD_FILE} is not there")
    steps = steps_left(folder, scenes, training, meta_act, every=every, processes=processes, workers=workers)
    folder.mkdir(parents=True, exist_ok=True)
    if meta_act is not None and not (folder / META_ACT).exists():
        (folder / META_ACT).symlink_to(meta_act.resolve(), target_is_directory=True)
    for step in steps:
        follow(step)


def steps_left(
    folder: Path,
    scenes: LadderScenes,
    training: Sequence[str],
    meta_act: Path | None = None,
    *,
    every: int,
    processes: int,
    workers: int,
) -> list[Step]:
    """What is still to be done, in order; arguments and ValueError as of `climb`."""
    steps: list[Step] = []
    if not _is_there(meta_act or folder / META_ACT):
        if not _is_there(folder / _UNTRAINED):
            to = ("--to", str(folder / _UNTRAINED))
            steps.append(Step(("train", "create", *to, "--scenes", str(scenes.train), *training)))
        own = _without(training, _OF_RECIPES)
        for entry in _GROUNDWORK:
            vision = ["--vision-from", str(folder / entry.vision)] if entry.vision else []
            steps += _trained(entry, folder, scenes.train, [*vision, *own], processes)
    wanted = {
        entry.build: _BUILDS[entry.build]
        for entry in _LADDER
        if not _reflections(folder, entry.build).exists() and not _is_there(folder / entry.name)
    }
    worlds = worlds_of(scenes) if any(build.followed for build in wanted.values()) else []
    for entry in _LADDER:
        if entry.build in wanted:
            steps += _built(wanted.pop(entry.build), folder, scenes, worlds, every, workers)
        options = ["--reflections", str(_reflections(folder, entry.build)), *training]
        steps += _trained(entry, folder, scenes.train, options, processes)
    table = ("evaluate", "--preset", "ladder", "--checkpoint", str(folder / COUNTERFACTUAL))
    kept = ("--plots", str(folder / "plots"), "--keep", str(folder / "draws.sqlite"))
    of = ("--ladder", str(folder), "--scenes", str(scenes.test), "--think-threshold", _THINK_THRESHOLD)
    return [*steps, Step((*table, *of, *kept))]


def worlds_of(scenes: LadderScenes) -> list[Path]:
    """Where plans can be followed: the files that are rolled out, and every folder that holds some.

    A folder has a manifest of its own, so `looktwice build outcomes` takes one after the other.

    Raises:
        ValueError: scenes that are rolled out are not trained on, or plans cannot be made or followed there.
            The text names them, and says why.
    """
    trained_on = {file.resolve() for file in scene_files(scenes.train)}
    worlds: list[Path] = []
    for place in scenes.planned_for:
        files = scene_files(place)
        if not trained_on.issuperset(file.resolve() for file in files):
            raise ValueError(f"--roll-out {place} is not among the scenes to train on, {scenes.train}")
        worlds += [place] if place.is_file() else sorted({file.parent for file in files})
    for world in worlds:
        try:
            _check_world(world, worlds)
        except ValueError as error:
            raise ValueError(
                f"the ladder follows plans in the simulator, and cannot in {world}: {error}. "
                "--roll-out names the scenes among those to train on that it is to take"
            ) from error
    return worlds


def _check_world(world: Path, worlds: Sequence[Path]) -> None:
    """Raise ValueError unless plans can be made and followed in the scenes of a file or folder."""
    if outer := [other for other in worlds if other in world.parents]:
        raise ValueError(f"{outer[0]} holds scenes too, and its manifest would count for both")
    redriver(setting_of(world), None)
    for labelled in islice(read_scenes(world, dense=False), 1):
        Moment.of(labelled)
        if not labelled.scene.has_pictures:
            raise ValueError("its scenes have no pictures to plan from")


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
    return (checkpoint / CARD_FILE).exists()


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


def _reflections(folder: Path, build: str) -> Path:
    """The file that a build ends in."""
    return folder / f"{build}.parquet"


def _built(
    build: Build, folder: Path, scenes: LadderScenes, worlds: Sequence[Path], every: int, workers: int
) -> list[Step]:
    """Everything from a checkpoint to a file of reflections on its plans."""
    place = str(folder / f"build-{build.name}")
    steps = [
        Step(("build", "rollout", place, str(path), "--every", str(every)), served=folder / build.entry)
        for path in scenes.planned_for
    ]
    keep, right = "--everything", list[str]()
    if build.followed:
        steps += [
            Step(("build", "outcomes", place, str(world), "--workers", str(workers))) for world in worlds
        ]
        keep, right = "--outcomes", ["--right-outcomes"]
    to = ("--to", str(_reflections(folder, build.name)))
    return [
        *steps,
        Step(("build", "filter", place, keep)),
        Step(("build", "label", place, str(scenes.train), "--plans-per-scene", str(_PLANS_PER_SCENE))),
        Step(("build", "export", place, *to, *right)),
    ]
