"""What would come of trajectories among others who move as they did in the recording.

The simulator lets others react (`looktwice.clients.metadrive.outcomes`) and judges a few trajectories a
second. Where nobody reacts, numpy judges thousands, and scenes need no simulator, only their annotations.
Whoever comes up from behind would have braked, so being hit from there is no failure.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.driven_car import CAR, Rides, follow_all, ride_states
from looktwice.model.driving.lane_map import LaneMap
from looktwice.model.driving.outcome import OFF_ROUTE_M, VERDICTS, failures
from looktwice.model.driving.pdm.comfort import comfort
from looktwice.model.driving.pdm.geometry import Boxes, Points, boxes_meet, near, on_line, to_edges
from looktwice.model.driving.pdm.labelled import areas_of_rings, past_states
from looktwice.model.driving.pdm.world import ACCELERATION, SPEED, Area
from looktwice.model.driving.scene import EGO_LENGTH_M, EGO_WIDTH_M, LabelledScene
from looktwice.model.driving.trajectory import FUTURE_STEPS, FloatArray

_HALF_LANE_M: Final = 1.75
_BEHIND_M: Final = 1.0
"""A vehicle whose centre is farther back than this, and that heads the same way, comes up from behind."""
_SAME_WAY: Final = 0.5
"""Cosine between two headings."""

BoolArray = npt.NDArray[np.bool_]
Verdicts = npt.NDArray[np.int64]
"""Places in `VERDICTS`."""


def verdicts_among_recorded(labelled: LabelledScene, trajectories: FloatArray) -> Verdicts | None:
    """What comes of trajectories [k, 64, 4] of a scene's ego frame, int64 [k].

    Returns:
        None where nobody can tell: the scene lacks its road or its lane map, or the expert's own way fails.
    """
    lane_map = labelled.lane_map
    if lane_map is None or not labelled.drivable:
        return None
    now = past_states(labelled.scene.history)[-1]
    # The expert's own way is the last one: what it breaks, others may break.
    ways = np.concatenate([trajectories, labelled.future[None]])
    rides = follow_all(ways, float(now[SPEED]), float(now[ACCELERATION]))
    boxes = Boxes.of(
        rides.poses[..., 0],
        rides.poses[..., 1],
        rides.poses[..., 2],
        np.array([[EGO_LENGTH_M]]),
        np.array([[EGO_WIDTH_M]]),
    )
    collided = _first_collisions(rides, boxes, labelled)
    # What comes after a collision is nobody's plan.
    counts = np.arange(FUTURE_STEPS) <= collided[:, None]
    off_road, off_route = (
        np.logical_or.reduce(each & counts, axis=1)
        for each in (_off_road(boxes, labelled), _off_route(rides, lane_map))
    )
    rough = ~comfort(ride_states(rides.poses, rides.speeds_ms), CAR, "v2.2").holds.astype(np.bool_)
    driven_m = _driven_m(rides, lane_map)
    found = [
        failures(
            collided=bool(collided[place] < FUTURE_STEPS),
            off_road=bool(off_road[place]),
            off_route=bool(off_route[place]),
            rough=bool(rough[place] and not rough[-1]),
            driven_m=float(driven_m[place]),
            expert_m=float(driven_m[-1]),
        )
        for place in range(len(driven_m))
    ]
    if found.pop():
        return None
    return np.array([VERDICTS.index(fails[0] if fails else "holds") for fails in found], np.int64)


def _first_collisions(rides: Rides, boxes: Boxes, labelled: LabelledScene) -> npt.NDArray[np.int64]:
    """The step [k] at which each ride first runs into somebody; 64 where it does not."""
    first = np.full(len(rides.poses), FUTURE_STEPS)
    agents = [agent for agent in labelled.agents if np.isfinite(agent.future).any()]
    if not agents:
        return first
    others = np.stack([agent.future for agent in agents], axis=1).astype(np.float64)  # [64, agents, 3]
    length, width = (np.array([getattr(agent, name) for agent in agents]) for name in ("length_m", "width_m"))
    there = Boxes.of(others[..., 0], others[..., 1], others[..., 2], length, width)
    ride, step, which = near(boxes, there)
    meets = boxes_meet(boxes[ride, step], there[step, which])
    # The first contact of two decides who ran into whom.
    order = np.flatnonzero(meets)[np.argsort(step[meets], kind="stable")]
    _, earliest = np.unique(ride[order] * len(agents) + which[order], return_index=True)
    ride, step, which = (each[order[earliest]] for each in (ride, step, which))
    x, y, heading = others[step, which].T
    own_x, own_y, own_heading = rides.poses[ride, step].T
    ahead = (x - own_x) * np.cos(own_heading) + (y - own_y) * np.sin(own_heading)
    comes_up = (ahead < -_BEHIND_M) & (np.cos(heading - own_heading) > _SAME_WAY)
    vehicle = np.array([agent.kind == "vehicle" for agent in agents])[which]
    counts = ~(vehicle & comes_up)
    np.minimum.at(first, ride[counts], step[counts])
    return first


def _off_road(boxes: Boxes, labelled: LabelledScene) -> BoolArray:
    """Whether a corner is beside the road, [k, 64]."""
    corners = boxes.corners()
    inside = Points(corners.reshape(-1, 2)).inside_any(areas_of_rings(labelled.drivable))
    found: BoolArray = ~np.logical_and.reduce(inside.reshape(corners.shape[:-1]), axis=2)
    return found


def _off_route(rides: Rides, lane_map: LaneMap) -> BoolArray:
    """Whether the centre has left all lanes of the route (`OFF_ROUTE_M`), [k, 64]."""
    lanes = [Area((lane.ring.astype(np.float64),)) for lane in lane_map.lanes if lane.on_route]
    centres = rides.poses[..., :2].reshape(-1, 2)
    beside_m = np.zeros(len(centres))
    if lanes:
        outside = ~Points(centres).inside_any(lanes)
        edges = np.concatenate([lane.edges for lane in lanes])
        beside_m[outside] = to_edges(centres[outside], edges)
    found: BoolArray = (beside_m > OFF_ROUTE_M - _HALF_LANE_M).reshape(rides.speeds_ms.shape)
    return found


def _driven_m(rides: Rides, lane_map: LaneMap) -> npt.NDArray[np.float64]:
    """Metres along the route's centre line, [k]; below 0 for whoever backs out."""
    line = lane_map.centreline.astype(np.float64)
    [began_m] = on_line(np.zeros((1, 2)), line).along_m
    driven_m: npt.NDArray[np.float64] = on_line(rides.poses[:, -1, :2], line).along_m - began_m
    return driven_m
