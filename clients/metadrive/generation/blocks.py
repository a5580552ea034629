"""Scenes at scale: one episode a seed, one Parquet file a block of seeds, resumable after any end."""

from __future__ import annotations

import json
import multiprocessing
import multiprocessing.connection
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import pyarrow.parquet as pq
import shapely
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from looktwice.clients.metadrive import simulator
from looktwice.clients.metadrive.closed_loop.drives import DriveConfig
from looktwice.clients.metadrive.closed_loop.pilots import Careless, Pilot
from looktwice.clients.metadrive.drawing.rig import Rig
from looktwice.clients.metadrive.generation.other_speeds import other_speeds
from looktwice.clients.metadrive.generation.own_states import own_states
from looktwice.clients.metadrive.scenes.windows import labelled_scenes, unpictured_scenes, window_steps
from looktwice.clients.metadrive.world.episode import run_episode, worlds_of_episode
from looktwice.clients.metadrive.world.maps import MapError
from looktwice.model.driving.cameras import FRONT_CAMERAS, SURROUND_CAMERAS
from looktwice.model.driving.scene import LabelledScene, split_of_seed
from looktwice.model.driving.scene_store import MANIFEST, SCENE_VERSION, write_scenes
from looktwice.model.driving.whole_files import written_whole

GENERATOR_VERSION: Final = "1"
_BLOCK: Final = re.compile(r"scenes-(\d+)-(\d+)\.parquet")
_EPISODES_KEY: Final = "looktwice.episodes"
_TRIES_PER_BLOCK: Final = 3


class GenerationError(RuntimeError):
    """Generation could not go on; what was written stays, and running again resumes."""


@dataclass(frozen=True)
class GenerateConfig:
    """What to generate.

    Attributes:
        stride_s: seconds between the scenes of an episode.
        duration_s: seconds an episode lasts.
        block: seeds in one file; a worker process lives for one block, so its memory stays bounded.
        surround: also render the six surround cameras.
        next_frames: also store what every camera sees half a second later.
        dense: also store per-pixel targets.
        drifts: the expert strays from its line now and then; scenes show how it comes back.
        lapses: it brakes late now and then; scenes show how it brakes then.
        speeds: in each scene the car is slower or faster than it was, by chance, and the expert goes on from
            there; such scenes have no pictures.
        width_px: of the pictures, which are twice as wide as high.
        driver: name and revision of the model that drives; scenes are then of its own states, with what the
            expert would do from there (`own_states`). None for the expert.
        tracks: whether that model is told the tracks of the objects around.
        careless: that model overlooks everybody around for up to two seconds now and then; scenes show how
            to brake then.
        pictures: whether scenes have any; without, they are made many times as fast, for planners that read
            tracks.
        teacher: name and revision of the small planner of tracks that says what to do in the expert's place,
            at once and in every moment. None for the expert.
        hazards: many hazards wait along the route of that model, and only moments with one ahead become
            scenes.
    """

    stride_s: float = 0.5
    duration_s: float = 48.0
    block: int = 20
    surround: bool = False
    next_frames: bool = False
    dense: bool = True
    drifts: bool = False
    lapses: bool = False
    speeds: bool = False
    width_px: int = 224
    driver: str | None = None
    tracks: bool = False
    careless: bool = False
    pictures: bool = True
    teacher: str | None = None
    hazards: bool = False

    def __post_init__(self) -> None:
        filmed = self.dense or self.surround or self.next_frames
        if self.driver is not None and (filmed or self.drifts or self.lapses):
            raise GenerationError(
                "scenes of a model's own drives have no dense targets, no surround cameras and no next "
                "frames, and its expert neither drifts nor lapses"
            )
        if self.driver is None and self.careless:
            raise GenerationError("only a model that drives can be careless; the expert has lapses")
        if self.driver is None and (self.hazards or self.teacher is not None):
            raise GenerationError("the expert needs no teacher, and knows its hazards: a model has to drive")
        if filmed and not self.pictures:
            raise GenerationError(
                "without pictures there are no dense targets, cameras around or next frames"
            )
        if self.speeds and (self.pictures or self.teacher is not None):
            raise GenerationError(
                "pictures do not show other speeds than were driven: such scenes have none, and the expert "
                "says what to do from there"
            )


@dataclass(frozen=True)
class EpisodeOutcome:
    """How one seed went."""

    seed: int
    outcome: str
    blocks: str
    scenes: int
    dropped: int
    seconds: float


@dataclass
class GenerateReport:
    """What a call of `generate` did."""

    scenes: int = 0
    blocks_written: int = 0
    blocks_resumed: int = 0
    seconds: float = 0.0
    outcomes: dict[str, int] = field(default_factory=dict)


def generate(
    out_dir: Path,
    seeds: range,
    workers: int = 2,
    config: GenerateConfig | None = None,
    console: Console | None = None,
    pilot: Callable[[], Pilot] | None = None,
    teacher: Callable[[], Pilot] | None = None,
) -> GenerateReport:
    """Generate the scenes of ``seeds`` into ``out_dir``; blocks that are there already are left alone.

    Args:
        out_dir: of the files.
        seeds: of the episodes.
        workers: processes.
        config: what to generate.
        console: of the progress bar.
        pilot: makes the model that drives, where the config names one; called in every worker process.
        teacher: makes the planner that says what to do, in the same way.

    Raises:
        SimulatorMissing: MetaDrive is not installed.
        SceneError: a seed that belongs to no split.
        GenerationError: a block failed again and again, or ``out_dir`` was made with another config.
    """
    config = config or GenerateConfig()
    if not simulator.is_installed():
        raise simulator.SimulatorMissing("MetaDrive is not installed; install it with `make sim`")
    for seed in (seeds[0], seeds[-1]):
        split_of_seed(seed)
    out_dir.mkdir(parents=True, exist_ok=True)
    _check_config(out_dir, config)
    report, started = GenerateReport(), time.monotonic()
    done = [block for block in _blocks_there(out_dir) if block[0] <= seeds[-1] and block[-1] >= seeds[0]]
    missing = _blocks_missing(seeds, done, config.block)
    report.blocks_resumed = len(done)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TimeRemainingColumn(), console=console) as progress:
        task = progress.add_task(
            out_dir.name, total=len(done) + len(missing), completed=report.blocks_resumed
        )
        for _ in _run_blocks(out_dir, missing, workers, config, pilot, teacher):
            report.blocks_written += 1
            progress.advance(task)
            write_manifest(out_dir, config)
    manifest = write_manifest(out_dir, config)
    report.scenes = manifest["scenes"]
    report.outcomes = manifest["outcomes"]
    report.seconds = time.monotonic() - started
    return report


def _blocks_there(out_dir: Path) -> list[range]:
    """The seeds of each file that is there."""
    names = (_BLOCK.fullmatch(file.name) for file in sorted(out_dir.glob("scenes-*.parquet")))
    return [range(int(name[1]), int(name[2]) + 1) for name in names if name is not None]


def _blocks_missing(seeds: range, done: Sequence[range], size: int) -> list[range]:
    """Seeds that are in no file yet, in blocks of at most ``size`` that follow each other."""
    covered, found = {seed for block in done for seed in block}, list[range]()
    for seed in seeds:
        if seed in covered:
            continue
        if found and found[-1][-1] == seed - 1 and len(found[-1]) < size:
            found[-1] = range(found[-1][0], seed + 1)
        else:
            found.append(range(seed, seed + 1))
    return found


def block_file(out_dir: Path, seeds: range) -> Path:
    """The file of a block of seeds."""
    return out_dir / f"scenes-{seeds[0]:06d}-{seeds[-1]:06d}.parquet"


def _check_config(out_dir: Path, config: GenerateConfig) -> None:
    manifest = out_dir / MANIFEST
    if not manifest.exists():
        return
    # What a folder's config does not name yet is as it always was.
    there = asdict(GenerateConfig()) | json.loads(manifest.read_text())["config"]
    if there != asdict(config):
        raise GenerationError(f"{out_dir} was generated with another config {there}; choose another folder")


def _run_blocks(
    out_dir: Path,
    blocks: Sequence[range],
    workers: int,
    config: GenerateConfig,
    pilot: Callable[[], Pilot] | None,
    teacher: Callable[[], Pilot] | None,
) -> Iterator[range]:
    """Run every block in a process of its own, ``workers`` at a time; a dead worker's is tried again."""
    context = multiprocessing.get_context("spawn")
    waiting = [(block, 1) for block in blocks]
    running: dict[Any, tuple[range, int]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                block, attempt = waiting.pop(0)
                arguments = (out_dir, block, config, pilot, teacher)
                process = context.Process(target=write_block, args=arguments, daemon=True)
                process.start()
                running[process] = (block, attempt)
            multiprocessing.connection.wait([process.sentinel for process in running])
            for process in [p for p in running if p.exitcode is not None]:
                block, attempt = running.pop(process)
                process.join()
                if process.exitcode == 0:
                    yield block
                elif attempt < _TRIES_PER_BLOCK:
                    waiting.insert(0, (block, attempt + 1))
                else:
                    raise GenerationError(
                        f"the worker for seeds {block[0]} to {block[-1]} ended with code {process.exitcode} "
                        f"{_TRIES_PER_BLOCK} times"
                    )
    finally:
        for process in running:
            process.kill()
            process.join()


def write_block(
    out_dir: Path,
    seeds: range,
    config: GenerateConfig,
    pilot: Callable[[], Pilot] | None = None,
    teacher: Callable[[], Pilot] | None = None,
) -> None:
    """Generate one block in this process and put its file in place."""
    rig = rig_of(config)
    scenes: list[LabelledScene] = []
    outcomes: list[EpisodeOutcome] = []
    driver, taught_by = (None if make is None else make() for make in (pilot, teacher))
    for seed in seeds:
        made, outcome = run_seed(seed, rig, config, driver, taught_by)
        scenes += made
        outcomes.append(outcome)
    if rig is not None:
        rig.close()
    described = json.dumps([asdict(outcome) for outcome in outcomes])
    write_scenes(block_file(out_dir, seeds), scenes, {_EPISODES_KEY: described})


def rig_of(config: GenerateConfig) -> Rig | None:
    """The cameras that look; None where nothing is seen."""
    cameras = FRONT_CAMERAS + (SURROUND_CAMERAS if config.surround else ())
    return Rig(tuple(camera.resized(config.width_px) for camera in cameras)) if config.pictures else None


class _EpisodeScenes(NamedTuple):
    """Scenes of an episode; how it ended, on a road of which blocks, and how many scenes there might be."""

    scenes: list[LabelledScene]
    ended: str
    blocks: str
    possible: int


def run_seed(
    seed: int,
    rig: Rig | None,
    config: GenerateConfig,
    pilot: Pilot | None = None,
    teacher: Pilot | None = None,
) -> tuple[list[LabelledScene], EpisodeOutcome]:
    """One episode's scenes, driven by a pilot or the expert, and how it went."""
    started = time.monotonic()
    try:
        if pilot is None:
            made = _of_expert(seed, rig, config)
        else:
            made = _of_pilot(seed, pilot, rig, config, teacher)
    except (MapError, shapely.errors.GEOSException) as error:
        return [], EpisodeOutcome(seed, type(error).__name__, "", 0, 0, time.monotonic() - started)
    count, seconds = len(made.scenes), round(time.monotonic() - started, 2)
    return made.scenes, EpisodeOutcome(seed, made.ended, made.blocks, count, made.possible - count, seconds)


def _of_expert(seed: int, rig: Rig | None, config: GenerateConfig) -> _EpisodeScenes:
    if config.speeds:
        worlds = worlds_of_episode(seed, config.duration_s, drifts=config.drifts, lapses=config.lapses)
        scenes, log, tried = other_speeds(worlds, config.stride_s)
        return _EpisodeScenes(scenes, log.outcome, log.road_map.blocks, tried)
    log = run_episode(seed, config.duration_s, drifts=config.drifts, lapses=config.lapses)
    if rig is None:
        scenes = list(unpictured_scenes(log, config.stride_s))
    else:
        scenes = list(labelled_scenes(log, rig, config.stride_s, config.dense, with_next=config.next_frames))
    return _EpisodeScenes(scenes, log.outcome, log.road_map.blocks, len(window_steps(log, config.stride_s)))


def _of_pilot(
    seed: int, pilot: Pilot, rig: Rig | None, config: GenerateConfig, teacher: Pilot | None
) -> _EpisodeScenes:
    every = max(1, round(config.stride_s / DriveConfig().replan_s))
    driver = pilot_of(config, pilot, seed)
    scenes, drove = own_states(
        seed,
        driver,
        rig,
        DriveConfig(config.duration_s),
        every,
        teacher,
        hazards=config.hazards,
        speeds=config.speeds,
    )
    return _EpisodeScenes(scenes, drove.ended, "", drove.plans // every)


def pilot_of(config: GenerateConfig, pilot: Pilot, seed: int) -> Pilot:
    """Who drives an episode: a pilot as it is, or careless."""
    return Careless(pilot, seed) if config.careless else pilot


def write_manifest(out_dir: Path, config: GenerateConfig) -> dict[str, Any]:
    """Write what ``out_dir`` holds, as told by its files, to ``manifest.json``; returns it."""
    episodes: list[dict[str, Any]] = []
    for file in sorted(out_dir.glob("scenes-*.parquet")):
        metadata = pq.read_schema(file).metadata or {}
        episodes += json.loads(metadata.get(_EPISODES_KEY.encode(), b"[]"))
    counts: dict[str, int] = {}
    for episode in episodes:
        counts[episode["outcome"]] = counts.get(episode["outcome"], 0) + 1
    manifest = {
        "generator_version": GENERATOR_VERSION,
        "scene_version": SCENE_VERSION,
        "simulator": simulator.described(),
        "config": asdict(config),
        "scenes": sum(episode["scenes"] for episode in episodes),
        "dropped": sum(episode["dropped"] for episode in episodes),
        "outcomes": counts,
        "seeds": [episode["seed"] for episode in episodes],
        "episodes": episodes,
    }
    with written_whole(out_dir / MANIFEST) as temporary:
        temporary.write_text(json.dumps(manifest, indent=1))
    return manifest
