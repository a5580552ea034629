"""What would come of small planners' sketches, and of the alternatives to them, in recorded scenes.

Thousands of scenes are judged in a minute (`looktwice.model.driving.recorded_outcome`), so a critic has a
million trajectories to learn from. Beside what its own planner sketches it sees what the other planner does,
what is sketched without knowing the route, and the expert's.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from looktwice.model.driving.recorded_outcome import verdicts_among_recorded
from looktwice.model.driving.scene_store import count_scenes, read_scenes, scene_files
from looktwice.model.driving.trajectory import FUTURE_STEPS, FloatArray
from looktwice.model.network.alternatives import ALTERNATIVES, with_alternatives
from looktwice.model.network.codec import TrajectoryCodec
from looktwice.model.network.route_line import RouteLine
from looktwice.model.network.trajectory_head import spread_of
from looktwice.model.network.vla import LookTwiceVla
from looktwice.model.training.examples import Examples
from looktwice.model.training.intents import IntentDataset
from looktwice.model.training.own_plans import planner_states

Planner = Literal["tracks", "read", "expert"]
SOURCES: Final[tuple[tuple[Planner, bool], ...]] = (
    ("tracks", True),
    ("read", True),
    ("tracks", False),
    ("read", False),
    ("expert", True),
)
"""Whose trajectories are judged, and whether the route is known."""
_POSE: Final = [0, 1, 3]


class JudgedSketches(NamedTuple):
    """Sketches, and what would come of each of them and of its alternatives.

    Attributes:
        examples: int64 [m], the examples that they begin in.
        poses: x, y and heading, float32 [m, sources, 64, 3]; see `SOURCES`.
        verdicts: int64 [m, sources, 1 + alternatives], places in `VERDICTS`, each sketch's own first.
    """

    examples: npt.NDArray[np.int64]
    poses: FloatArray
    verdicts: npt.NDArray[np.int64]


class _FileWork(NamedTuple):
    """The sketches of one file's scenes; arrays as in `Examples` and `JudgedSketches`."""

    file: Path
    scene_id: npt.NDArray[np.str_]
    history: FloatArray
    route: FloatArray
    has_route: npt.NDArray[np.bool_]
    poses: FloatArray


def judge_sketches(
    vla: LookTwiceVla,
    codec: TrajectoryCodec,
    examples: Examples,
    read: FloatArray,
    scenes: Path,
    workers: int,
) -> JudgedSketches:
    """Judge what the small planners of a checkpoint sketch in all scenes that tell enough.

    Args:
        vla: with both small planners.
        codec: of the sketches.
        examples: the scenes as arrays.
        read: of `read_facts`.
        scenes: file or folder that the examples came from.
        workers: processes that judge; 0 judges here.

    Raises:
        ValueError: no scene tells its road, lanes and route.
    """
    poses = _sketches(vla, codec, examples, read)
    works = _works(scenes, examples, poses)
    if workers:
        # Not forked: a copy of a process whose threads multiply matrices may hang.
        with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _one_thread) as pool:
            found = np.concatenate(list(pool.map(_verdicts_in_file, works)))
    else:
        found = np.concatenate(list(map(_verdicts_in_file, works)))
    known = np.flatnonzero((found >= 0).all(axis=(1, 2)))
    if not len(known):
        raise ValueError("no scene tells its route, its road and its lanes, so no sketch can be judged")
    return JudgedSketches(known, poses[known], found[known])


def _sketches(vla: LookTwiceVla, codec: TrajectoryCodec, examples: Examples, read: FloatArray) -> FloatArray:
    """x, y and heading [n, sources, 64, 3] of what is sketched in all examples."""
    assert vla.sketch_books is not None
    assert vla.resampler is not None
    spread, data = spread_of(vla.sketch_books.books[0]), IntentDataset(examples, read, route_share=1.0)
    planners: dict[str, Any] = {"tracks": vla.track_reader, "read": vla.resampler.intent}
    found = []
    for source, route in SOURCES:
        if source == "expert":
            found.append(examples.future)
            continue
        planner = planners[source]
        with torch.inference_mode():
            states, _ = planner_states(planner, data, source, mirror=False, route=route)
            vectors = planner.sketch(states.to(planner.sketch.weight.dtype)).float() * spread
        found.append(codec.trajectories(examples.history, vectors.cpu().numpy()))
    return np.stack(found, axis=1)[..., _POSE].astype(np.float32)


def _works(scenes: Path, examples: Examples, poses: FloatArray) -> Iterator[_FileWork]:
    """The files of a folder in their order, as `load_examples` reads them."""
    start = 0
    for file in scene_files(scenes):
        each = slice(start, start + count_scenes(file))
        yield _FileWork(
            file,
            examples.scene_id[each],
            examples.history[each],
            np.nan_to_num(examples.route[each]),
            examples.has_route[each],
            poses[each],
        )
        start = each.stop


def _one_thread() -> None:
    torch.set_num_threads(1)


def _verdicts_in_file(work: _FileWork) -> npt.NDArray[np.int64]:
    """What comes of each scene's sketches and alternatives, [n, sources, 1 + alternatives]; -1 if unknown."""
    shape = (len(work.scene_id), len(SOURCES), 1 + len(ALTERNATIVES))
    verdicts = np.full(shape, -1, np.int64)
    history, route = torch.from_numpy(work.history), torch.from_numpy(work.route)
    ways = []
    for number, (_, knows) in enumerate(SOURCES):
        line = RouteLine.of(route, torch.from_numpy(work.has_route & knows))
        ways.append(with_alternatives(torch.from_numpy(work.poses[:, number]), history, line))
    poses = torch.stack(ways, dim=1).flatten(1, 2).numpy()
    for place, labelled in enumerate(read_scenes(work.file, dense=False)):
        assert labelled.scene.scene_id == work.scene_id[place], "examples are in the order of their file"
        if labelled.scene.route is None:
            continue
        trajectories = np.zeros((poses.shape[1], FUTURE_STEPS, 4), np.float32)
        trajectories[..., _POSE] = poses[place]
        found = verdicts_among_recorded(labelled, trajectories)
        if found is not None:
            verdicts[place] = found.reshape(shape[1:])
    return verdicts
