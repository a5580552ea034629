"""Worlds of generated scenes once more: an episode is driven again, and can be forked at each scene's moment.

A scene tells its seed and its step, its folder's manifest how the generator was set. Whatever was made
otherwise has no world that could be made again, and is refused by name.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import shapely

from looktwice.clients.metadrive import simulator
from looktwice.clients.metadrive.generation.blocks import GENERATOR_VERSION, GenerateConfig
from looktwice.clients.metadrive.generation.redrive import DescribedPilot, Redriver
from looktwice.clients.metadrive.outcomes.verdicts import MomentOutcomes, outcomes_at
from looktwice.clients.metadrive.scenes.windows import history_at
from looktwice.clients.metadrive.world.episode import EpisodeWorld, worlds_of_episode
from looktwice.clients.metadrive.world.fork import fork_expert
from looktwice.clients.metadrive.world.maps import MapError
from looktwice.model.driving.scene import LabelledScene, Scene
from looktwice.model.driving.scene_store import MANIFEST
from looktwice.model.driving.trajectory import FloatArray

TOLERANCE_M: Final = 0.01
"""Metres and radians between a stored scene and its world made again; mostly they are equal to the bit."""
_SCENE_ID: Final = re.compile(r"(\d{6})-(\d{4})")


class ReplayError(ValueError):
    """Scenes whose worlds cannot be made again; the text says why."""


@dataclass(frozen=True)
class EpisodeSetting:
    """What decides an episode besides its seed; see `GenerateConfig`.

    ``driver`` is the name and revision of the model that drove in the expert's place, None for the expert.
    """

    duration_s: float
    drifts: bool
    lapses: bool
    driver: str | None = None
    careless: bool = False
    hazards: bool = False
    width_px: int = 0

    @property
    def config(self) -> GenerateConfig:
        """Of the generator, as far as it decides an episode."""
        return GenerateConfig(**asdict(self), pictures=self.width_px > 0, dense=False)


def redriver(setting: EpisodeSetting, makes: Callable[[], DescribedPilot] | None) -> Redriver | None:
    """Who drives in the expert's place when worlds are made again; None for the expert.

    Args:
        setting: of the episodes.
        makes: the model; None where the expert drives.

    Raises:
        ReplayError: another one drove.
    """
    pilot = None if makes is None else makes()
    drives = None if pilot is None else pilot.described
    if drives != setting.driver:
        raise ReplayError(
            f"{setting.driver or 'the expert'} drove these episodes, not {drives or 'the expert'}: "
            "whoever drove has to drive again"
        )
    return None if pilot is None else Redriver(setting.config, pilot)


@dataclass(frozen=True, eq=False)
class Moment:
    """A stored scene as far as its world must be like it.

    Attributes:
        scene_id: of the scene.
        seed, step: of its episode, and when in it.
        history: float32 [16, 4].
        future: float32 [64, 4], the expert's.
    """

    scene_id: str
    seed: int
    step: int
    history: FloatArray
    future: FloatArray

    @classmethod
    def of(cls, labelled: LabelledScene) -> Moment:
        """The moment of a generated scene.

        Raises:
            ReplayError: it was not generated.
        """
        named = _SCENE_ID.fullmatch(labelled.scene.scene_id)
        if named is None or int(named[1]) != labelled.seed:
            raise ReplayError(
                f"scene {labelled.scene.scene_id} is not one of `looktwice scenes generate`: "
                "its name does not tell seed and step"
            )
        return cls(
            labelled.scene.scene_id, labelled.seed, int(named[2]), labelled.scene.history, labelled.future
        )


class FollowTask(NamedTuple):
    """What is to be followed from one moment.

    Attributes:
        moment: from which.
        trajectories: float32 [64, 4], of plans.
        others: for each of them what is tried instead where it fails; see `outcomes_at`.
    """

    moment: Moment
    trajectories: Sequence[FloatArray]
    others: Sequence[Sequence[FloatArray]] = ()


def setting_of(scenes: Path) -> EpisodeSetting:
    """How the episodes of a folder of scenes, or of one of its files, were set.

    Raises:
        ReplayError: they were not generated, or by another generator or simulator.
    """
    manifest = (scenes if scenes.is_dir() else scenes.parent) / MANIFEST
    if not manifest.is_file():
        raise ReplayError(
            f"{manifest} is not there: only scenes of `looktwice scenes generate` have a world to fork, "
            "imported and bundled ones have none"
        )
    try:
        told = json.loads(manifest.read_text())
        made_by, simulated_by = told["generator_version"], told["simulator"]
        config = dict(told["config"])
    except (ValueError, KeyError, TypeError) as error:
        raise ReplayError(f"{manifest} is not a manifest of generated scenes: {error}") from error
    if made_by != GENERATOR_VERSION:
        raise ReplayError(
            f"{manifest.parent} was made by generator {made_by}, this is generator {GENERATOR_VERSION}: "
            "its worlds cannot be made again"
        )
    if simulated_by != simulator.described():
        raise ReplayError(f"{manifest.parent} was made with {simulated_by}, here is {simulator.described()}")
    if unknown := set(config) - {field.name for field in fields(GenerateConfig)}:
        raise ReplayError(
            f"{manifest.parent} was made with settings unknown here: {', '.join(sorted(unknown))}"
        )
    whole = asdict(GenerateConfig()) | config
    if whole["teacher"] is not None:
        raise ReplayError(
            f"{manifest.parent} holds what {whole['teacher']} says in the expert's place: nothing can be "
            "judged by that"
        )
    if whole["speeds"]:
        raise ReplayError(f"{manifest.parent} holds scenes at other speeds than were driven")
    common = whole["duration_s"], whole["drifts"], whole["lapses"]
    if whole["driver"] is None:
        return EpisodeSetting(*common)
    width_px = whole["width_px"] if whole["pictures"] else 0
    return EpisodeSetting(*common, whole["driver"], whole["careless"], whole["hazards"], width_px)


def replayed(
    seed: int, setting: EpisodeSetting, moments: Sequence[Moment]
) -> Iterator[tuple[Moment, EpisodeWorld | ReplayError]]:
    """Drive an episode once more and stop at some moments of it, in the order of time.

    Yields each moment with the world as it is then, which must not be moved; or with what keeps it from being
    the stored scene's.
    """
    waiting = sorted(moments, key=lambda moment: moment.step)
    try:
        for world in worlds_of_episode(
            seed, setting.duration_s, drifts=setting.drifts, lapses=setting.lapses
        ):
            while waiting and waiting[0].step == world.now:
                moment = waiting.pop(0)
                yield moment, world if _is_same(world, moment) else _differs(moment)
            if not waiting:
                return
    except (MapError, shapely.errors.GEOSException) as error:
        for moment in waiting:
            yield moment, ReplayError(f"scene {moment.scene_id}: no map is made of seed {seed}: {error}")
        return
    for moment in waiting:
        yield moment, ReplayError(f"scene {moment.scene_id}: its episode ended before, when made again")


def outcomes_of_episode(
    seed: int, setting: EpisodeSetting, asked: Sequence[FollowTask], driver: Redriver | None = None
) -> Iterator[tuple[str, MomentOutcomes | ReplayError]]:
    """What comes of plans at some moments of one episode, which is driven once.

    Args:
        seed, setting: of the episode.
        asked: moments, each with what is to be followed from it.
        driver: whoever drove in the expert's place.

    Yields:
        Scene ids with how their plans fared, or why that cannot be said.
    """
    if driver is not None:
        yield from _on_the_way(seed, asked, driver)
        return
    tasks = {task.moment.scene_id: task for task in asked}
    for moment, world in replayed(seed, setting, [task.moment for task in asked]):
        task = tasks[moment.scene_id]
        yield moment.scene_id, world if isinstance(world, ReplayError) else _outcomes(world, task)


def _on_the_way(
    seed: int, asked: Sequence[FollowTask], driver: Redriver
) -> Iterator[tuple[str, MomentOutcomes | ReplayError]]:
    """The same where a pilot drives: plans are followed while it does."""
    waiting = {task.moment.step: task for task in asked}
    found: list[tuple[str, MomentOutcomes | ReplayError]] = []

    def meet(world: EpisodeWorld, _: Scene) -> None:
        if (task := waiting.pop(world.now, None)) is not None:
            found.append((task.moment.scene_id, _met(world, task)))

    ended = "its episode ended before, when made again"
    try:
        driver.drive(seed, meet)
    except (MapError, shapely.errors.GEOSException) as error:
        ended = f"no map is made of seed {seed}: {error}"
    yield from found
    for task in waiting.values():
        yield task.moment.scene_id, ReplayError(f"scene {task.moment.scene_id}: {ended}")


def _met(world: EpisodeWorld, task: FollowTask) -> MomentOutcomes | ReplayError:
    return _outcomes(world, task) if _is_same(world, task.moment) else _differs(task.moment)


def _outcomes(world: EpisodeWorld, task: FollowTask) -> MomentOutcomes | ReplayError:
    driven = fork_expert(world)
    if not _near(driven.trajectory, task.moment.future):
        return _differs(task.moment)
    return outcomes_at(world, task.trajectories, task.others, driven)


def _is_same(world: EpisodeWorld, moment: Moment) -> bool:
    return world.now >= len(moment.history) - 1 and _near(history_at(world.live, world.now), moment.history)


def _near(one: FloatArray, other: FloatArray) -> bool:
    return one.shape == other.shape and bool(np.abs(one - other).max() <= TOLERANCE_M)


def _differs(moment: Moment) -> ReplayError:
    return ReplayError(
        f"scene {moment.scene_id}: its episode went otherwise when it was made again; "
        "was it made by this generator, with this manifest's settings?"
    )
