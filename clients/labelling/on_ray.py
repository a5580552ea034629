"""Stages of a build on a Ray cluster, with Ray Data: workers do row groups of scenes, the ledger stays here.

A row group (up to 128 scenes) is what a cluster that dies can lose; everything else is as on one machine.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import ray

from looktwice.clients import wire
from looktwice.clients.labelling import build_outcomes, label, rollout
from looktwice.clients.labelling.ledger import Entered, Entry, Ledger, StageRun
from looktwice.clients.labelling.pipeline import Job, StageLimits, StageStopped, Tally, work_through
from looktwice.clients.labelling.rollout import RETRY_POLICY, Sampling, roll_out
from looktwice.clients.labelling.teachers.teacher import Teacher, TeacherError
from looktwice.clients.planner import Access, AsyncPlannerClient
from looktwice.model.driving.scene_store import row_groups, scene_files


@dataclass(frozen=True)
class Chunk:
    """A row group of a scene file, and what the ledger knows about its scenes.

    Attributes:
        file, group: where the scenes are; every worker must be able to read the file.
        done: keys that are not to be done again.
        begun: answers to questions that were broken off; for labelling.
        kept: rollouts of scenes that were kept, with their draws; for labelling.
        followed: what came of their plans, where they were followed; for labelling.
    """

    file: Path
    group: int
    done: frozenset[str]
    begun: Entered
    kept: tuple[tuple[Entry, list[int]], ...] = ()
    followed: tuple[Entry, ...] = ()


class Work(Protocol):
    """What a worker does with a chunk; travels to it."""

    @property
    def run(self) -> StageRun:
        """What its outcomes belong to."""
        ...

    def __call__(self, book: Ledger, chunk: Chunk, unlabelled: Callable[[str], None]) -> Awaitable[Tally]:
        """Enter into ``book`` what came of the chunk; ``unlabelled`` is told of scenes without a future."""
        ...


@dataclass(frozen=True)
class RolloutWork:
    """See `looktwice.clients.labelling.rollout`."""

    run: StageRun
    service: str
    access: Access
    model: wire.ModelName
    sampling: Sampling
    limits: StageLimits

    async def __call__(self, book: Ledger, chunk: Chunk, unlabelled: Callable[[str], None]) -> Tally:
        """Roll the chunk's scenes out."""
        book.run(self.run.stage, self.run.config)
        found = rollout.jobs(self.run, chunk.file, unlabelled, chunk.group)
        async with AsyncPlannerClient(self.service, RETRY_POLICY, access=self.access) as planner:
            return await work_through(
                book,
                self.run,
                _open(found, chunk),
                lambda job: roll_out(planner, job.subject, self.model, self.sampling),
                self.limits,
            )


@dataclass(frozen=True)
class LabelWork:
    """See `looktwice.clients.labelling.label`; ``connect`` is called for every chunk, where it is worked
    on."""

    run: StageRun
    rollout: StageRun
    connect: Callable[[], Awaitable[Teacher]]
    plans_per_scene: int
    seed: int
    limits: StageLimits

    async def __call__(self, book: Ledger, chunk: Chunk, unlabelled: Callable[[str], None]) -> Tally:
        """Have the chunk's plans looked at."""
        for run in (self.run, self.rollout):
            book.run(run.stage, run.config)
        for entry, _ in chunk.kept:
            book.finish(self.rollout, entry.key, entry.scene_id, entry.record)
        outcomes_run = book.run("outcomes", build_outcomes.config_of(self.rollout))
        for entry in chunk.followed:
            book.finish(outcomes_run, entry.key, entry.scene_id, entry.record)
        book.select(self.rollout, [(entry.key, draws) for entry, draws in chunk.kept])
        book.take_over(self.run, chunk.begun)
        asked = label.questions(
            book,
            self.rollout,
            chunk.file,
            plans_per_scene=self.plans_per_scene,
            seed=self.seed,
            group=chunk.group,
        )
        try:
            teacher = await self.connect()
        except TeacherError as error:
            raise StageStopped(str(error)) from error
        try:
            return await work_through(
                book,
                self.run,
                _open(label.jobs(self.run, asked), chunk),
                label.labeller(book, self.run, teacher),
                self.limits,
            )
        finally:
            await teacher.close()


def chunks(ledger: Ledger, run: StageRun, scenes: Path, rollout: StageRun | None = None) -> Iterator[Chunk]:
    """The row groups of scene files; with a ``rollout`` those with kept scenes, and what is kept."""
    kept: dict[str, list[tuple[Entry, list[int]]]] = {}
    begun = ledger.begun(run)
    followed = {} if rollout is None else build_outcomes.followed_entries(ledger, rollout)
    if rollout is not None:
        for entry in ledger.entries(rollout):
            found = ledger.selected(entry.key)
            if found is not None:
                kept.setdefault(entry.scene_id, []).append(found)
    for file in scene_files(scenes):
        for group, names in enumerate(row_groups(file)):
            mine = tuple(each for name in names for each in kept.get(name, ()))
            if rollout is None or mine:
                fates = tuple(followed[entry.key] for entry, _ in mine if entry.key in followed)
                done = frozenset(ledger.keys_of(run, names))
                yield Chunk(file.resolve(), group, done, begun, mine, fates)


def work_on_ray(
    ledger: Ledger,
    run: StageRun,
    found: Iterator[Chunk],
    work: Work,
    address: str,
    on_progress: Callable[[Tally], None] = lambda _: None,
    unlabelled: Callable[[str], None] = lambda _: None,
) -> Tally:
    """Have chunks done on a cluster and enter what comes back.

    Args:
        ledger: here.
        run: what the outcomes belong to.
        found: see `chunks`.
        work: `RolloutWork` or `LabelWork`.
        address: of the cluster; ``local`` starts one in this machine.
        on_progress: told after every chunk.
        unlabelled: told of scenes that have no expert's future.

    Raises:
        StageStopped: a worker stopped; what others have done is entered.
    """
    ray.init(address=address, ignore_reinit_error=True, log_to_driver=False)
    tally, began_s = Tally(), time.monotonic()
    items = [{"chunk": chunk} for chunk in found]
    if not items:
        return tally
    do = partial(_work_in_worker, work=work)
    done = ray.data.from_items(items, override_num_blocks=len(items)).map(do)
    stopped = ""
    for row in done.iter_rows():
        ledger.take_over(run, Entered(**json.loads(row["entered"])))
        tally.done += row["done"]
        tally.dead += row["dead"]
        tally.earlier += row["earlier"]
        stopped = stopped or row["stopped"]
        for name in json.loads(row["unlabelled"]):
            unlabelled(name)
        on_progress(replace(tally))
    if stopped:
        raise StageStopped(stopped)
    tally.seconds = time.monotonic() - began_s
    return tally


def _work_in_worker(item: dict[str, Any], work: Work) -> dict[str, Any]:
    """One chunk, in a worker's process; errors that stop a stage come back as text, with what was done.

    What comes back is made of numbers and texts, as Ray Data keeps rows in Arrow's types.
    """
    chunk: Chunk = item["chunk"]
    unlabelled: list[str] = []
    with Ledger(None) as book:
        stopped, tally = "", Tally()
        try:
            tally = asyncio.run(_awaited(work, book, chunk, unlabelled.append))
        except StageStopped as error:
            stopped = str(error)
        entered = json.dumps(book.entered(work.run)._asdict())
    return {
        "entered": entered,
        "done": tally.done,
        "dead": tally.dead,
        "earlier": len(chunk.done),
        "unlabelled": json.dumps(unlabelled),
        "stopped": stopped,
    }


async def _awaited(work: Work, book: Ledger, chunk: Chunk, unlabelled: Callable[[str], None]) -> Tally:
    return await work(book, chunk, unlabelled)


def _open(found: Iterator[Job[Any]], chunk: Chunk) -> Iterator[Job[Any]]:
    return (job for job in found if job.key not in chunk.done)
