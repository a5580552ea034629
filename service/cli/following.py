"""`looktwice scenes follow`: a small planner's trajectories and their alternatives in the simulator."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch

from looktwice.clients.metadrive.outcomes import (
    DescribedPilot,
    FollowTask,
    Moment,
    follow_unknown,
    outcome_store,
    redriver,
    setting_of,
)
from looktwice.model.driving.followed_store import FollowedTrajectory, Led, write_followed
from looktwice.model.driving.hashing import hash_of
from looktwice.model.driving.scene import Scene
from looktwice.model.driving.scene_store import count_scenes, read_scenes
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.network.alternatives import ALTERNATIVES, alternatives
from looktwice.model.network.route_line import RouteLine
from looktwice.service.cli.progress import progress_on_stderr
from looktwice.service.cli.small_pilot import SmallPilot

_POSE = [0, 1, 3]
"""x, y and heading."""


def follow_sketches(
    scenes: Path,
    out: Path,
    planner: SmallPilot,
    also: int,
    workers: int,
    drove: Callable[[], DescribedPilot] | None = None,
    *,
    quiet: bool,
) -> Counter[str]:
    """Write what comes of a small planner's trajectories in generated scenes.

    What is known is kept beside ``out`` meanwhile: started again after a kill, it goes on from there.

    Args:
        scenes: generated ones, a file or a folder; those without a route are left out.
        out: the file to write.
        planner: whose trajectories.
        also: so many of each one's alternatives, drawn by the scene's name.
        workers: processes.
        drove: the model that drove when the scenes were made, where it was not the expert.
        quiet: without a progress bar.

    Returns:
        How many trajectories ended in each verdict; ``expert fails`` counts scenes that were left out since
        the expert's own way fails too, ``not followed`` those whose world cannot be made again.

    Raises:
        ReplayError: these scenes' worlds cannot be made again, or another model drove.
        SceneError: a scene lacks what the planner needs.
        WorkerDied: a process died.
    """
    setting = setting_of(scenes)
    redriver(setting, drove)
    taken: dict[str, tuple[list[FloatArray], list[Led]]] = {}

    def asked() -> Iterator[FollowTask]:
        for labelled in read_scenes(scenes, dense=False):
            if labelled.scene.route is None:
                continue
            scene = labelled.given(route=True, tracks=True)
            trajectories, mends = _driven(scene, planner, also)
            taken[scene.scene_id] = trajectories, mends
            yield FollowTask(Moment.of(labelled), trajectories)

    rows: list[FollowedTrajectory] = []
    counts = Counter[str]()
    known = outcome_store(out.with_name(f"{out.name}.outcomes"))
    out.parent.mkdir(parents=True, exist_ok=True)
    with progress_on_stderr(quiet=quiet) as progress:
        task = progress.add_task("scenes followed", total=count_scenes(scenes))
        for scene_id, outcomes in follow_unknown(asked(), setting, workers, known, drove):
            progress.advance(task)
            if isinstance(outcomes, str) or not outcomes.expert.holds:
                counts["not followed" if isinstance(outcomes, str) else "expert fails"] += 1
                continue
            for trajectory, mend, outcome in zip(*taken[scene_id], outcomes.plans, strict=True):
                counts[outcome.verdict] += 1
                row = scene_id, trajectory, mend, outcome.verdict, planner.described
                rows.append(FollowedTrajectory(*row))
    write_followed(out, rows)
    return counts


def _driven(scene: Scene, planner: SmallPilot, also: int) -> tuple[list[FloatArray], list[Led]]:
    """A planner's trajectory [64, 4] and some of its alternatives, and the mends that led to them."""
    own = np.asarray(planner.plan(scene).trajectory)
    line = RouteLine.of(torch.tensor(np.asarray(scene.route))[None], torch.ones(1, dtype=torch.bool))
    others = alternatives(torch.tensor(own[None][..., _POSE]), torch.tensor(scene.history)[None], line)[0]
    chance = np.random.default_rng(int(hash_of(scene.scene_id), 16))
    places = sorted(chance.choice(len(ALTERNATIVES), size=min(also, len(ALTERNATIVES)), replace=False))
    trajectories = [own]
    for place in places:
        trajectory = np.zeros_like(own)
        trajectory[:, _POSE] = others[place].numpy()
        trajectories.append(trajectory)
    mends: list[Led] = ["", *(ALTERNATIVES[place] for place in places)]
    return trajectories, mends
