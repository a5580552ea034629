"""The scene graph of one episode: its map, its light and its actors, posed at any step."""

from __future__ import annotations

import colorsys
import math
from typing import Any, Final

import numpy as np

from looktwice.clients.metadrive import simulator
from looktwice.clients.metadrive.drawing import map_meshes
from looktwice.clients.metadrive.drawing.meshes import box
from looktwice.clients.metadrive.drawing.model_meshes import GAIT_CYCLE_M, GAIT_POSES, model_meshes
from looktwice.clients.metadrive.drawing.rig import RenderedPicture, Rig
from looktwice.clients.metadrive.world.actors import BODY_SIZES
from looktwice.clients.metadrive.world.episode_log import (
    BRAKE_LIGHT,
    LEFT_LIGHT,
    RIGHT_LIGHT,
    ActorLog,
    EpisodeLog,
)

_BLINK_STEPS: Final = 4
_LAMP_DEPTH_M: Final = {"beetle": 0.28, "130": 0.06}
_LAMPS: Final = {
    BRAKE_LIGHT: (1.0, 0.06, 0.05),
    LEFT_LIGHT: (1.0, 0.62, 0.05),
    RIGHT_LIGHT: (1.0, 0.62, 0.05),
}


class Stage:
    """One episode ready to be photographed."""

    def __init__(self, log: EpisodeLog, rig: Rig) -> None:
        self._log, self._rig = log, rig
        core = simulator.panda()
        self._world = rig.root.attachNewNode("episode")
        look = map_meshes.make_appearance(log.seed)
        rig.set_sky(look.sky)
        self._flat(
            map_meshes.ground_mesh(log.road_map, look.ground),
            1,
            map_meshes.noise_texture(log.seed, 128, 0.5, "g"),
        )
        asphalt = map_meshes.noise_texture(log.seed + 1, 128, 0.28, "a")
        self._flat(map_meshes.road_mesh(log.road_map, look.asphalt), 2, asphalt)
        self._flat(map_meshes.kerb_mesh(log.road_map), 3, None)
        self._flat(map_meshes.marking_mesh(log.road_map), 4, None)
        map_meshes.roadside_mesh(log.road_map, log.seed).node("roadside").reparentTo(self._world)
        self._light(core, look)
        self._actors = [_ActorNode(actor, self._world) for actor in log.actors]

    def _flat(self, mesh: Any, order: int, texture: Any) -> None:
        """Flat layers are painted one over the other; only the lowest takes part in depth."""
        node = mesh.node(f"flat{order}")
        node.setBin("background", order)
        node.setTwoSided(True)
        node.setFogOff()
        node.setLightOff()
        if order > 1:
            node.setDepthTest(False)
            node.setDepthWrite(False)
        if texture is not None:
            node.setTexture(texture)
        node.reparentTo(self._world)

    def _light(self, core: Any, look: map_meshes.Appearance) -> None:
        ambient = core.AmbientLight("ambient")
        ambient.setColor((look.ambient, look.ambient, look.ambient * 1.05, 1))
        sun = core.DirectionalLight("sun")
        sun.setColor((*look.sun, 1))
        direction = self._world.attachNewNode(sun)
        direction.setHpr(look.sun_heading, -look.sun_height, 0)
        self._world.setLight(self._world.attachNewNode(ambient))
        self._world.setLight(direction)
        haze = core.Fog("haze")
        haze.setColor(*look.sky)
        haze.setLinearRange(60, 420)
        self._world.setFog(haze)

    def shoot(self, step: int) -> list[RenderedPicture]:
        """The pictures at ``step`` of the episode."""
        x, y, heading, _ = self._log.ego[step]
        self._rig.ego.setPos(x, y, 0)
        self._rig.ego.setH(math.degrees(heading))
        for actor in self._actors:
            actor.pose(step)
        return self._rig.shoot()

    def close(self) -> None:
        """Take the episode off the stage."""
        self._world.removeNode()


class _ActorNode:
    def __init__(self, log: ActorLog, world: Any) -> None:
        self._log = log
        self._node = world.attachNewNode(f"{log.kind}{log.actor_id}")
        self._bodies = [mesh.node(log.model) for mesh in model_meshes(log.model)]
        for body in self._bodies:
            body.reparentTo(self._node)
            body.setColorScale(*_tint(log), 1)
            body.hide()
        self._lamps: dict[int, Any] = {}
        if log.kind == "vehicle":
            _wheels(log.model).reparentTo(self._node)
            for bit in _LAMPS:
                self._lamps[bit] = _lamp(log.model, bit)
                self._lamps[bit].reparentTo(self._node)

    def pose(self, step: int) -> None:
        x, y, heading = self._log.poses[step]
        if not np.isfinite(x):
            self._node.hide()
            return
        self._node.show()
        self._node.setPos(x, y, 0)
        self._node.setH(math.degrees(heading))
        shown = int(self._log.phase[step] / GAIT_CYCLE_M * GAIT_POSES) % len(self._bodies)
        for k, body in enumerate(self._bodies):
            body.show() if k == shown else body.hide()
        for bit, lamp in self._lamps.items():
            lit = bool(self._log.lights[step] & bit)
            if bit != BRAKE_LIGHT:
                lit = lit and ((step + 3 * self._log.actor_id) // _BLINK_STEPS) % 3 != 2
            lamp.show() if lit else lamp.hide()


def _tint(log: ActorLog) -> tuple[float, float, float]:
    if log.kind != "vehicle":
        return (1.7, 1.15, 1.0) if log.kind == "barrier" else (1.0, 1.0, 1.0)
    hue = (log.tint * 7.13) % 1.0
    return colorsys.hsv_to_rgb(hue, 0.15 + 0.6 * log.tint, 1.25 if log.model == "beetle" else 1.5)


def _lamp(model: str, bit: int) -> Any:
    length, width, height = BODY_SIZES[model]
    sides = {BRAKE_LIGHT: (1, -1), LEFT_LIGHT: (1,), RIGHT_LIGHT: (-1,)}[bit]
    node = simulator.panda().NodePath("lamp")
    for side in sides:
        inset = {"beetle": 0.34, "130": 0.30}[model] - (0.0 if bit == BRAKE_LIGHT else 0.16)
        at = (-length / 2 + _LAMP_DEPTH_M[model], side * (width / 2 - inset), 0.55 * height)
        size = (0.30, 0.28, 0.17) if bit == BRAKE_LIGHT else (0.32, 0.20, 0.19)
        box(at, size, _LAMPS[bit]).node("lamp").reparentTo(node)
        if bit != BRAKE_LIGHT:
            front = (length / 2 - 0.35, side * (width / 2 - 0.1), 0.45 * height)
            box(front, (0.3, 0.2, 0.16), _LAMPS[bit]).node("lamp").reparentTo(node)
    node.setLightOff()
    node.flattenStrong()
    return node


def _wheels(model: str) -> Any:
    length, width, _ = BODY_SIZES[model]
    node = simulator.panda().NodePath("wheels")
    for along in (0.29, -0.29):
        for side in (1, -1):
            at = (along * length, side * (width / 2 - 0.12), 0.31)
            box(at, (0.62, 0.24, 0.62), (0.06, 0.06, 0.06)).node("wheel").reparentTo(node)
            hub = (along * length, side * (width / 2 + 0.005), 0.31)
            box(hub, (0.3, 0.02, 0.3), (0.5, 0.5, 0.52)).node("hub").reparentTo(node)
    node.flattenStrong()
    return node
