"""The contract of GET /v1/scenes and POST /v1/scenes:read: scenes to look at."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from looktwice.clients.wire.base import Camera, Length, Light, Nearby, Point, ResponseModel, Trajectory
from looktwice.clients.wire.scene import Scene, Track


class Agent(ResponseModel):
    """Another road user or obstacle of a labelled scene, as an oriented box over past and future."""

    agent_id: int
    kind: str = Field(description="vehicle, pedestrian, cone or barrier.")
    length_m: Length
    width_m: Length
    poses: list[Annotated[list[Nearby], Field(min_length=3, max_length=3)] | None] = Field(
        fail_fast=True,
        min_length=80,
        max_length=80,
        description="80 poses (x, y in m, heading in rad) at 10 Hz, row 15 is now; null where absent.",
    )
    lights: list[Light] = Field(
        default_factory=list,
        max_length=3,
        description="Those that are on now; left and right together are hazard lights.",
    )


class NextImage(ResponseModel):
    """What one camera saw half a second after a scene."""

    camera: Camera = Field(description="Which camera.")
    image: str = Field(description="JPEG, PNG or WebP in base64.")


class LabelledScene(ResponseModel):
    """A scene with what is known about it besides, for looking at; `scene` can be planned for as it is."""

    scene: Scene
    episode_id: str
    seed: int
    future: Trajectory
    agents: list[Agent]
    drivable: list[list[Point]] = Field(
        description="Closed rings; a point is on the road when an odd number of rings contains it."
    )
    lane_lines: list[list[Point]] = Field(description="Centre lines of the lanes around.")
    tracks: list[Track] = Field(
        default_factory=list,
        description="What a perfect tracker would tell of the agents, for `scene.tracks`.",
    )
    tags: list[str] = Field(description="What makes the scene difficult.")
    next_images: list[NextImage] = Field(
        default_factory=list,
        description="What cameras saw half a second later, beside which imagined pictures can be held; empty "
        "where that is not known.",
    )


class SceneEntry(ResponseModel):
    """A line in the list of bundled scenes."""

    scene_id: str
    tags: list[str]


class SceneList(ResponseModel):
    """Answer of GET /v1/scenes."""

    scenes: list[SceneEntry]


class SceneFile(ResponseModel):
    """Answer of POST /v1/scenes:read."""

    scenes: list[LabelledScene]
