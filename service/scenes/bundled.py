"""The bundled scenes, and labelled scenes as the inspector page shows them."""

from __future__ import annotations

import base64
import functools
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Final, cast

import looktwice.clients.wire as wire
from looktwice.clients.wire_values import rows, wire_agents, wire_scene, wire_tracks
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.scene_store import SceneFileError, read_scenes
from looktwice.model.driving.tracks import tracks_of
from looktwice.service.problems import SCENES_UNREADABLE, UNKNOWN_SCENE, ProblemError

MAX_SCENES_SHOWN: Final = 64

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
            raise ProblemError(
                SCENES_UNREADABLE, file_error_text(error, self._path, self._path.name)
            ) from error

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


def view(labelled: LabelledScene) -> wire.LabelledScene:
    """A labelled scene as the page shows it; its `scene` can be sent to /v1/plan as it is."""
    return wire.LabelledScene(
        scene=wire_scene(labelled.scene, _DECIMALS),
        episode_id=labelled.episode_id,
        seed=labelled.seed,
        future=rows(labelled.future, _DECIMALS),
        agents=wire_agents(labelled.agents, _DECIMALS),
        drivable=[rows(ring, _DECIMALS) for ring in labelled.drivable],
        lane_lines=[rows(line, _DECIMALS) for line in labelled.lane_lines],
        tracks=wire_tracks(tracks_of(labelled.agents), _DECIMALS),
        tags=sorted(labelled.tags),
        next_images=[
            wire.NextImage(camera=cast(wire.Camera, each.camera), image=base64.b64encode(each.image).decode())
            for each in labelled.next_frames
        ],
    )


def file_error_text(error: SceneFileError, path: Path, name: str) -> str:
    """What is wrong with the file at ``path``, under another name."""
    # Where files lie on the server is nobody's business.
    return str(error).replace(str(path), name).strip()
