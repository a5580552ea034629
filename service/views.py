"""Labelled scenes for the inspector page, and the files they come from."""

from __future__ import annotations

import base64
import functools
import tempfile
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Final, cast

import numpy as np
import pyarrow.parquet as pq

import clients.wire as wire
from model.driving.scene import Agent, LabelledScene
from model.driving.scene_store import SceneFileError, count_scenes, read_scenes
from model.driving.trajectory import FloatArray
from service.problems import INVALID_SCENE_FILE, SCENES_UNREADABLE, UNKNOWN_SCENE, ProblemError

MAX_SCENES_SHOWN: Final = 64
MAX_SCENES_IN_FILE: Final = 1000
MAX_UNPACKED_BYTES: Final = 256_000_000
"""Of a dropped file: Parquet packs so well that a small file could fill the memory."""

_DECIMALS: Final = 3


class BundledScenes:
    """The demo scenes of one file or folder, read once, at first use."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def all(self) -> Sequence[LabelledScene]:
        """Every bundled scene; none where the file is missing.

        Raises:
            ProblemError: the file is there and cannot be read.
        """
        try:
            return self._scenes
        except SceneFileError as error:
            raise ProblemError(SCENES_UNREADABLE, _told(error, self._path, self._path.name)) from error

    def one(self, scene_id: str) -> LabelledScene:
        """The scene of that name; raises `ProblemError`."""
        for labelled in self.all():
            if labelled.scene.scene_id == scene_id:
                return labelled
        raise ProblemError(UNKNOWN_SCENE, f"no bundled scene is called {scene_id!r}; see /v1/scenes")

    @functools.cached_property
    def _scenes(self) -> tuple[LabelledScene, ...]:
        if not self._path.exists():
            return ()
        return tuple(islice(read_scenes(self._path, dense=False), MAX_SCENES_SHOWN))


def scenes_of_file(content: bytes) -> list[wire.LabelledScene]:
    """The first scenes of an uploaded Parquet file; raises `ProblemError` where it is none of ours."""
    with tempfile.TemporaryDirectory(prefix="looktwice-") as folder:
        path = Path(folder) / "scenes.parquet"
        path.write_bytes(content)
        try:
            _refuse_bombs(path)
            return [view(scene) for scene in islice(read_scenes(path, dense=False), MAX_SCENES_SHOWN)]
        except SceneFileError as error:
            raise ProblemError(INVALID_SCENE_FILE, _told(error, path, "the file")) from error


def view(labelled: LabelledScene) -> wire.LabelledScene:
    """A labelled scene as the page shows it; its `scene` can be sent to /v1/plan as it is."""
    scene = labelled.scene
    return wire.LabelledScene(
        scene=wire.Scene(
            scene_id=scene.scene_id,
            clips=[
                wire.Clip(
                    camera=cast(wire.Camera, clip.camera),
                    images=[base64.b64encode(image).decode() for image in clip.images],
                )
                for clip in scene.clips
            ],
            history=_rows(scene.history),
            route=None if scene.route is None else _rows(scene.route),
        ),
        episode_id=labelled.episode_id,
        seed=labelled.seed,
        future=_rows(labelled.future),
        agents=[_agent(agent) for agent in labelled.agents],
        drivable=[_rows(ring) for ring in labelled.drivable],
        lane_lines=[_rows(line) for line in labelled.lane_lines],
        tags=sorted(labelled.tags),
    )


def _agent(agent: Agent) -> wire.Agent:
    return wire.Agent(
        agent_id=agent.agent_id,
        kind=agent.kind,
        length_m=agent.length_m,
        width_m=agent.width_m,
        poses=[row if np.isfinite(row).all() else None for row in _rows(agent.poses)],
    )


def _rows(array: FloatArray) -> list[list[float]]:
    return cast("list[list[float]]", array.astype(float).round(_DECIMALS).tolist())


def _refuse_bombs(path: Path) -> None:
    if count_scenes(path) > MAX_SCENES_IN_FILE:
        raise SceneFileError(f"{path} holds more than {MAX_SCENES_IN_FILE} scenes")
    footer = pq.read_metadata(path)
    unpacked = sum(footer.row_group(group).total_byte_size for group in range(footer.num_row_groups))
    if unpacked > MAX_UNPACKED_BYTES:
        raise SceneFileError(
            f"{path} would unpack to {unpacked} bytes; at most {MAX_UNPACKED_BYTES} are read"
        )


def _told(error: SceneFileError, path: Path, name: str) -> str:
    # Where files lie on the server is nobody's business.
    return str(error).replace(str(path), name).strip()
