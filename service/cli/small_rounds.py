"""Small planners, trained round by round: drive, let the expert say what it would do, learn from it.

Every round leaves a folder of its own with the scenes that its planner met, as `scenes generate --small`
makes them, so a killed run goes on with the round that it was in.
"""

from __future__ import annotations

import shutil
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Final

import typer
from rich.progress import Progress, TextColumn

from looktwice.clients.metadrive.generation import GenerateConfig, generate
from looktwice.model.driving.scene import split_of_seed
from looktwice.model.driving.whole_files import written_whole
from looktwice.model.network.codec import CODEC_FILE, TrajectoryCodec
from looktwice.model.network.small_planner import (
    WEIGHTS_FILE,
    SmallKind,
    SmallPlannerError,
    how_it_was_made,
)
from looktwice.model.training.small import SmallSettings, train_small
from looktwice.service.cli.small_pilot import SmallPilot

FIRST_ROUND_SEED: Final = 200_000
"""Training seeds that no scenes are made of by default; every round drives new ones."""
_SCENES: Final = "scenes"
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
        SmallPlannerError: a round's planner was trained otherwise.
    """
    if rounds and kind == "blind":
        raise ValueError("rounds are for the teacher: a blind planner cannot see what it should learn")
    codec = TrajectoryCodec.load(codec_from)
    own: list[Path] = []
    for number in range(rounds + 1):
        folder = target / f"round-{number}"
        if number:
            own.append(folder / _SCENES)
            first = FIRST_ROUND_SEED + (number - 1) * episodes
            _drive(target / f"round-{number - 1}", range(first, first + episodes), own[-1])
        if (folder / WEIGHTS_FILE).exists():
            _check_made_so(folder, kind, settings)
        else:
            _train(kind, scenes, codec, folder, settings, validation, own)
    for name in (CODEC_FILE, WEIGHTS_FILE):
        with written_whole(target / name) as temporary:
            shutil.copyfile(target / f"round-{rounds}" / name, temporary)


def _check_made_so(folder: Path, kind: SmallKind, settings: SmallSettings) -> None:
    found_kind, details = how_it_was_made(folder)
    if (found_kind, details["settings"]) != (kind, asdict(settings)):
        raise SmallPlannerError(
            f"{folder} has a {found_kind} planner of other settings ({details['settings']}): "
            "name another folder"
        )


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


def _drive(planner: Path, seeds: range, out: Path) -> None:
    """Let a planner drive ``seeds`` and label what it meets, unless that was done before."""
    for seed in (seeds[0], seeds[-1]):
        if split_of_seed(seed) != "train":
            raise ValueError(f"seed {seed} is not a training seed: fewer rounds or episodes, please")
    config = GenerateConfig(
        stride_s=1.0, duration_s=_SECONDS, dense=False, driver=SmallPilot(planner).described, pictures=False
    )
    report = generate(out, seeds, workers=1, config=config, pilot=partial(SmallPilot, planner))
    ends = ", ".join(f"{count} {outcome}" for outcome, count in sorted(report.outcomes.items()))
    typer.echo(f"{out.parent.name}: {report.scenes} own states; {ends}")
