"""Small planners, trained round by round: drive, let the expert say what it would do, learn from it.

Every round leaves a folder of its own, so a killed run goes on with the round that it was in.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Final

import numpy as np
import typer
from rich.progress import Progress, TextColumn

from clients.metadrive.drive import DriveConfig
from clients.metadrive.maps import MapError
from clients.metadrive.own_states import own_states
from model.driving.scene import LabelledScene, split_of_seed
from model.network.codec import TrajectoryCodec
from model.network.small_planner import WEIGHTS_FILE, SmallKind, small_inputs
from model.training.small import SmallExamples, SmallSettings, train_small
from service.cli.small_pilot import SmallPilot

FIRST_ROUND_SEED: Final = 200_000
"""Training seeds that no scenes are made of by default; every round drives new ones."""
_STATES_FILE: Final = "own-states.npz"
_SECONDS: Final = 38.0


def train_small_in_rounds(
    kind: SmallKind,
    scenes: Path,
    codec_from: Path,
    target: Path,
    settings: SmallSettings,
    validation: Path | None,
    rounds: int,
    episodes: int,
) -> None:
    """Train a small planner on scenes, then ``rounds`` times on its own states as well.

    Raises:
        ValueError: rounds for the blind planner, which they would not help.
    """
    if rounds and kind == "blind":
        raise ValueError("rounds are for the teacher: a blind planner cannot see what it should learn")
    codec = TrajectoryCodec.load(codec_from)
    own: list[Path] = []
    for number in range(rounds + 1):
        folder = target / f"round-{number}"
        if number:
            states = folder / _STATES_FILE
            if not states.exists():
                first = FIRST_ROUND_SEED + (number - 1) * episodes
                _collect(target / f"round-{number - 1}", range(first, first + episodes), states)
            own.append(states)
        if not (folder / WEIGHTS_FILE).exists():
            _train(kind, scenes, codec, folder, settings, validation, own)
    for file in (target / f"round-{rounds}").iterdir():
        if file.name != _STATES_FILE:
            shutil.copyfile(file, target / file.name)


def _train(
    kind: SmallKind,
    scenes: Path,
    codec: TrajectoryCodec,
    folder: Path,
    settings: SmallSettings,
    validation: Path | None,
    own: list[Path],
) -> None:
    with Progress(*Progress.get_default_columns(), TextColumn("{task.fields[ade]}")) as progress:
        task = progress.add_task(f"{kind} {folder.name}", total=settings.steps, ade="")
        figures = train_small(
            kind,
            [scenes],
            codec,
            folder,
            settings,
            validation,
            own,
            lambda step, ade: progress.update(task, completed=step, ade=f"ADE {ade:.2f} m"),
        )
    for name, value in figures.items():
        typer.echo(f"{kind} {folder.name} {name} {value:.3f}")


def _collect(planner: Path, seeds: range, path: Path) -> None:
    """Drive ``seeds`` and keep the labelled states in one file."""
    for seed in (seeds[0], seeds[-1]):
        if split_of_seed(seed) != "train":
            raise ValueError(f"seed {seed} is not a training seed: fewer rounds or episodes, please")
    pilot = SmallPilot(planner)
    states: list[LabelledScene] = []
    collisions = 0
    with Progress() as progress:
        task = progress.add_task(f"{path.parent.name}: driving", total=len(seeds))
        for seed in seeds:
            try:
                found, drove = own_states(seed, pilot, config=DriveConfig(_SECONDS))
            except MapError:
                continue
            finally:
                progress.advance(task)
            states += found
            collisions += drove.ended == "collision"
    typer.echo(f"{path.parent.name}: {len(states)} own states, {collisions} collisions")
    path.parent.mkdir(parents=True, exist_ok=True)
    _examples(states).save(path)


def _examples(states: list[LabelledScene]) -> SmallExamples:
    inputs = small_inputs([state.given(route=True, tracks=True) for state in states], "teacher")
    return SmallExamples.of_arrays(
        inputs.history.numpy(),
        inputs.route.numpy(),
        inputs.tracks.numpy(),
        np.stack([state.future for state in states]),
        np.array([state.seed for state in states]),
    )
