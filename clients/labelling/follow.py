"""Follow: the free draws of a rollout in the simulator, scene by scene.

Worker processes do it (`looktwice.clients.metadrive.outcomes`). The ledger stays with whoever gave the
command; what is entered there is not done again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from itertools import groupby, islice
from pathlib import Path
from typing import Any, NamedTuple

from looktwice.clients.labelling.ledger import Ledger, StageRun
from looktwice.clients.labelling.pipeline import StageLimits, StageStopped, Tally
from looktwice.clients.labelling.rollout import key_of, unpacked
from looktwice.clients.metadrive.outcomes import (
    DescribedPilot,
    EpisodeSetting,
    FollowTask,
    Moment,
    MomentOutcomes,
    WorkerDied,
    follow_episodes,
    setting_of,
)
from looktwice.model.driving.direction import wanted_changes
from looktwice.model.driving.hashing import hash_of
from looktwice.model.driving.mends import MENDS, Mend, mended, mended_plan
from looktwice.model.driving.plan import Plan, parse_plan
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.trajectory import FloatArray


class _Mended(NamedTuple):
    """A plan's trajectory with a mend, and the plan that it carries out."""

    mend: Mend
    trajectory: FloatArray
    plan: Plan


@dataclass(frozen=True, eq=False)
class _Work:
    """A scene's place in the ledger, its moment, and what is followed from it.

    Attributes:
        key, rollout: in the ledger, of the outcomes and of the rollout.
        moment: of the scene.
        trajectories: float32 [64, 4], of the free draws.
        mends: for each of them, in the order in which they are tried.
    """

    key: str
    rollout: str
    moment: Moment
    trajectories: tuple[FloatArray, ...]
    mends: tuple[tuple[_Mended, ...], ...]

    @property
    def task(self) -> FollowTask:
        """What is asked of the simulator."""
        others = [[each.trajectory for each in mends] for mends in self.mends]
        return FollowTask(self.moment, self.trajectories, others)


def follow_all(
    ledger: Ledger,
    run: StageRun,
    rollout: StageRun,
    scenes: Path,
    workers: int,
    limits: StageLimits = StageLimits(),
    on_progress: Callable[[Tally], None] = lambda _: None,
    makes: Callable[[], DescribedPilot] | None = None,
) -> Tally:
    """Follow the free draws of every rolled-out scene, and enter what comes of them.

    Args:
        ledger: with the rollout.
        run: what the outcomes belong to.
        rollout: whose draws.
        scenes: generated scenes, a file or a folder; those that were not rolled out are passed over.
        workers: processes.
        limits: ``at_most`` and ``max_error_rate`` count here.
        on_progress: told after every scene.
        makes: the model that drove when the scenes were made, where it was not the expert.

    Raises:
        ReplayError: these scenes' worlds cannot be made again, or another model drove.
        StageStopped: too many errors, or a process died; what is entered stays.
    """
    setting = setting_of(scenes)
    tally, began_s, faults = Tally(), time.monotonic(), 0
    works: dict[str, _Work] = {}

    def episodes() -> Iterator[list[FollowTask]]:
        for episode in _episodes(_works(ledger, run, rollout, scenes, setting, tally), limits.at_most):
            works.update((work.moment.scene_id, work) for work in episode)
            yield [work.task for work in episode]

    try:
        for scene_id, found in follow_episodes(episodes(), setting, workers, makes):
            faults += _enter(ledger, run, works.pop(scene_id), found, tally)
            on_progress(tally)
            count = tally.done + tally.dead
            if limits.too_many(faults, count):
                raise StageStopped(f"{faults} of {count} scenes could not be followed; see dead letters")
    except WorkerDied as error:
        raise StageStopped(f"{error}; the same command goes on") from error
    tally.seconds = time.monotonic() - began_s
    return tally


def _enter(ledger: Ledger, run: StageRun, work: _Work, found: MomentOutcomes | str, tally: Tally) -> bool:
    """Enter what came of a scene; returns whether something went wrong."""
    if isinstance(found, str):
        ledger.dead_letter(run, work.key, work.moment.scene_id, found)
        tally.dead += 1
        return True
    record: dict[str, Any] = {
        "rollout": work.rollout,
        "expert": found.expert.to_json(),
        "plans": [plan.to_json() for plan in found.plans],
        "mends": [
            None if place is None else {"mend": mends[place].mend, "plan": str(mends[place].plan)}
            for mends, place in zip(work.mends, found.better, strict=True)
        ],
    }
    ledger.finish(run, work.key, work.moment.scene_id, record)
    tally.done += 1
    return False


def _episodes(works: Iterator[_Work], at_most: int | None) -> Iterator[list[_Work]]:
    """What is to be done, episode by episode as far as files hold them together."""
    for _, episode in groupby(islice(works, at_most), lambda work: work.moment.seed):
        yield list(episode)


def _works(
    ledger: Ledger, run: StageRun, rollout: StageRun, scenes: Path, setting: EpisodeSetting, tally: Tally
) -> Iterator[_Work]:
    """The rolled-out scenes whose plans were not followed yet; the others are counted."""
    begun: set[str] = set()
    for labelled in read_scenes(scenes, dense=False, unlabelled=lambda _: None):
        entry = ledger.find(key_of(rollout, labelled))
        if entry is None:
            continue
        key = hash_of(run.id, entry.key, asdict(setting))
        if ledger.has(key) or key in begun:
            tally.earlier += 1
            continue
        begun.add(key)
        trajectories = tuple(unpacked(draw["trajectory"]) for draw in entry.record["free"])
        expert = parse_plan(entry.record["expert_plan"])
        mends = tuple(
            tuple(_mends(labelled, parse_plan(draw["plan"]), trajectory, expert))
            for draw, trajectory in zip(entry.record["free"], trajectories, strict=True)
        )
        yield _Work(key, entry.key, Moment.of(labelled), trajectories, mends)


def _mends(labelled: LabelledScene, plan: Plan, trajectory: FloatArray, expert: Plan) -> Iterator[_Mended]:
    """The mends that a plan's words can tell, the smallest first."""
    history = labelled.scene.history
    for mend in MENDS:
        changed = mended(mend, trajectory, labelled.future, history)
        better = mended_plan(mend, plan, changed, expert, history)
        if wanted_changes(plan, better):
            yield _Mended(mend, changed, better)
