"""Plans of many scenes followed at once: worker processes take whole episodes, each driven once."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Final

from looktwice.clients.metadrive.generation.redrive import DescribedPilot, Redriver
from looktwice.clients.metadrive.outcomes.replayed_worlds import (
    EpisodeSetting,
    FollowTask,
    ReplayError,
    outcomes_of_episode,
    redriver,
)
from looktwice.clients.metadrive.outcomes.verdicts import MomentOutcomes

_EPISODES_A_PROCESS: Final = 20
"""Then it is replaced, so that its memory stays bounded."""


class WorkerDied(RuntimeError):
    """A process ended before its work: killed, or out of memory."""


def follow_episodes(
    episodes: Iterator[Sequence[FollowTask]],
    setting: EpisodeSetting,
    workers: int,
    makes: Callable[[], DescribedPilot] | None = None,
) -> Iterator[tuple[str, MomentOutcomes | str]]:
    """Follow plans in so many processes; they end with this one, however it ends.

    Args:
        episodes: each what is asked of one episode; taken as they are needed.
        setting: of all of them.
        workers: processes.
        makes: whoever drove in the expert's place; called in every process.

    Yields:
        Scene ids as their episodes are done, with how their plans fared or why that cannot be said.

    Raises:
        ReplayError: another one drove.
        WorkerDied: see there.
    """
    redriver(setting, makes)  # before any process begins
    begun: set[Future[list[tuple[str, MomentOutcomes | str]]]] = set()
    with ProcessPoolExecutor(
        workers,
        multiprocessing.get_context("spawn"),
        initializer=_begin,
        initargs=(setting, makes),
        max_tasks_per_child=_EPISODES_A_PROCESS,
    ) as pool:
        try:
            while True:
                # One more than may run waits, so that a process has work as soon as it is free.
                while len(begun) <= workers and (asked := next(episodes, None)) is not None:
                    begun.add(pool.submit(_follow_episode, setting, asked))
                if not begun:
                    return
                ended, begun = wait(begun, return_when=FIRST_COMPLETED)
                for future in ended:
                    yield from future.result()
        except BrokenProcessPool as error:
            raise WorkerDied("a process that followed plans died: it was killed, or lacked memory") from error
        finally:
            for future in begun:
                future.cancel()


def _follow_episode(
    setting: EpisodeSetting, asked: Sequence[FollowTask]
) -> list[tuple[str, MomentOutcomes | str]]:
    """One episode in a process of its own; what cannot be followed is told as text."""
    return [
        (scene_id, str(found) if isinstance(found, ReplayError) else found)
        for scene_id, found in outcomes_of_episode(asked[0].moment.seed, setting, asked, _drivers[0])
    ]


_drivers: Final[list[Redriver | None]] = []
"""The one of this process."""


def _begin(setting: EpisodeSetting, makes: Callable[[], DescribedPilot] | None) -> None:
    _end_with_parent()
    _drivers.append(redriver(setting, makes))


def _end_with_parent() -> None:
    """End this process when its parent does, however that ends: nobody is left who would take its work."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
