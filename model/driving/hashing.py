"""Names for what was asked, so that an answer to it can be found again."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import numpy.typing as npt

from looktwice.model.driving.scene import LabelledScene, Scene


def hash_of(*parts: object) -> str:
    """32 hex digits that stand for parts: bytes as they are, all else as JSON."""
    digest = hashlib.sha256()
    for part in parts:
        content = part if isinstance(part, bytes) else json.dumps(part, sort_keys=True).encode()
        digest.update(len(content).to_bytes(8, "big") + content)
    return digest.hexdigest()[:32]


def scene_hash(scene: Scene) -> str:
    """Stands for a scene with its name, its pictures, its way, behind and ahead, and its tracks."""
    arrays = (scene.history, *(() if scene.route is None else (scene.route,)))
    pictures = [picture for clip in scene.clips for picture in (clip.camera.encode(), *clip.images)]
    tracks = () if scene.tracks is None else ([vars(t) | {"lights": sorted(t.lights)} for t in scene.tracks],)
    return hash_of(scene.scene_id, *pictures, *(array.tobytes() for array in arrays), *tracks)


def annotations_hash(labelled: LabelledScene) -> str:
    """Stands for what is known about a scene besides what a planner is given: future, agents, road, tags."""
    agents: list[object] = []
    for agent in labelled.agents:
        size = (agent.length_m, agent.width_m, agent.height_m)
        agents += [agent.agent_id, agent.kind, size, sorted(agent.lights), agent.poses.tobytes()]
    trace = labelled.lane_trace
    lanes: tuple[npt.NDArray[Any], ...] = () if trace is None else (trace.road, trace.lane, trace.offset_m)
    groups = ((labelled.future,), labelled.drivable, labelled.lane_lines, lanes)
    arrays = [part for group in groups for part in (len(group), *(array.tobytes() for array in group))]
    return hash_of(len(labelled.agents), *agents, *arrays, sorted(labelled.tags))


def judged_hash(labelled: LabelledScene) -> str:
    """Stands for all that plans in a scene are judged by: its annotations, and its lane map."""
    known = labelled.lane_map
    if known is None:
        return annotations_hash(labelled)
    lanes = [part for lane in known.lanes for part in (lane.lane_id, lane.on_route, lane.ring.tobytes())]
    rings = [ring.tobytes() for ring in known.intersections]
    rest = (known.centreline.tobytes(), known.has_lights)
    return hash_of(annotations_hash(labelled), len(known.lanes), *lanes, len(rings), *rings, *rest)
