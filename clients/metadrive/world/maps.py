"""Maps from a seed: blocks of MetaDrive in a row, as lanes in our own frame."""

from __future__ import annotations

from collections import deque
from typing import Any, Final

import numpy as np

from looktwice.clients.metadrive import simulator
from looktwice.clients.metadrive.world.roads import LineMark, RoadLane, RoadMap, RoadSegment, Turn, with_rails
from looktwice.clients.metadrive.world.y_flip import centre_line_from_metadrive

_LANE_SPACING_M: Final = 1.0
_BLOCK_WEIGHTS: Final = {"S": 0.42, "C": 0.22, "X": 0.11, "T": 0.09, "O": 0.03, "r": 0.07, "R": 0.06}
_TRIES_PER_BLOCK: Final = 6
_TRIES_PER_MAP: Final = 20
_MARKS: Final[dict[str, LineMark]] = {"broken": "broken", "continuous": "solid", "side": "solid"}
_FIRST_BLOCK_M: Final = 50.0


class _NoWorld:
    """Stands in for the simulator's physics, which geometry does not need."""

    def attach(self, node: Any) -> None:
        """Nothing to attach to."""

    def remove(self, node: Any) -> None:
        """Nothing to remove from."""

    @property
    def dynamic_world(self) -> _NoWorld:
        """Itself."""
        return self

    static_world = dynamic_world


class MapError(RuntimeError):
    """No map could be laid out for a seed."""


def make_map(seed: int, length_m: float) -> RoadMap:
    """A map whose route is at least ``length_m`` long; the same for the same seed.

    Raises:
        MapError: blocks overlapped in every attempt.
    """
    for attempt in range(_TRIES_PER_MAP):
        rng = np.random.default_rng([seed, attempt, 1])
        laid_out = _lay_out(rng, length_m)
        if laid_out is None:
            continue
        network, end, letters = laid_out
        found = _read(network, end, letters)
        if found is not None and found.rails and found.length > 0.8 * length_m:
            return found
    raise MapError(f"seed {seed}: no map of {length_m:.0f} m without overlaps")


def _parameters(letter: str, rng: np.random.Generator) -> dict[str, Any]:
    if letter == "S":
        return {"length": float(rng.uniform(70, 200))}
    if letter == "C":
        return {
            "length": float(rng.uniform(40, 120)),
            "radius": float(rng.choice([rng.uniform(25, 50), rng.uniform(60, 160), rng.uniform(150, 320)])),
            "angle": float(rng.uniform(15, 75)),
            "dir": int(rng.integers(2)),
        }
    return {}


def _lay_out(rng: np.random.Generator, length_m: float) -> tuple[Any, str, str] | None:
    classes = simulator.block_classes()
    core = simulator.panda()
    network, root, world = simulator.new_road_network(), core.NodePath("map"), _NoWorld()
    lanes = int(rng.choice([2, 3, 4, 5], p=[0.36, 0.36, 0.2, 0.08]))
    width = float(rng.uniform(3.3, 3.8))
    blocks = [classes["I"](network, width, lanes, root, world, length=_FIRST_BLOCK_M)]
    letters, covered = "", _FIRST_BLOCK_M
    while covered < length_m:
        weights = dict(_BLOCK_WEIGHTS)
        if letters and letters[-1] in "XTO":
            weights = {"S": 0.7, "C": 0.3}
        if letters and letters[-1] == "C":
            weights["C"] = 0.05
        if lanes >= 4:
            weights.pop("O", None)
            weights.pop("r", None)
        for _ in range(_TRIES_PER_BLOCK):
            names = list(weights)
            p = np.array([weights[name] for name in names])
            letter = str(rng.choice(names, p=p / p.sum()))
            sockets = blocks[-1].get_socket_indices()
            socket = blocks[-1].get_socket(sockets[int(rng.integers(len(sockets)))])
            block = classes[letter](len(blocks), socket, network, int(rng.integers(10_000)))
            fits = block.construct_block(root, world, _parameters(letter, rng))
            if fits:
                blocks.append(block)
                letters += letter
                covered += {"S": 130.0, "C": 110.0, "r": 120.0, "R": 100.0}.get(letter, 75.0)
                break
            block.destruct_block(world)
        else:
            return None
    return network, _end_node(blocks[-1], rng), letters


def _end_node(block: Any, rng: np.random.Generator) -> str:
    sockets = block.get_socket_indices()
    return str(block.get_socket(sockets[int(rng.integers(len(sockets)))]).positive_road.end_node)


def _reverse(node: str) -> str:
    return node[1:] if node.startswith("-") else f"-{node}"


def _read(network: Any, end: str, letters: str) -> RoadMap | None:
    lanes: list[RoadLane] = []
    roads: list[RoadSegment] = []
    edges: dict[str, list[int]] = {}
    for start, ways in network.graph.items():
        if start.startswith("decoration"):
            continue
        for stop, raw_lanes in ways.items():
            road = len(roads)
            first = len(lanes)
            for number, raw in enumerate(raw_lanes):
                marks = [_MARKS.get(str(mark), "none") for mark in raw.line_types]
                centre = centre_line_from_metadrive(raw, _LANE_SPACING_M)
                lanes.append(RoadLane(len(lanes), road, number, centre, float(raw.width), marks[0], marks[1]))
            ids = tuple(range(first, len(lanes)))
            turn = _turn(lanes[first], start, stop, network)
            roads.append(RoadSegment(road, start, stop, ids, turn))
            edges.setdefault(start, []).append(road)
    route = _shortest(edges, roads, ">", end)
    oncoming = _shortest(edges, roads, _reverse(end), "->")
    if not route:
        return None
    return with_rails(RoadMap(tuple(lanes), tuple(roads), route, oncoming, letters))


def _turn(lane: RoadLane, start: str, stop: str, network: Any) -> Turn | None:
    block = stop.lstrip("-")
    kind = next((c for c in block if c.isalpha()), "")
    other = next((c for c in start.lstrip("-") if c.isalpha()), "")
    if "O" in (kind, other):
        return "ring"
    if len(network.graph[start]) < 2 or not {"X", "T"} & {kind, other}:
        return None
    step = np.diff(lane.centre, axis=0)
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    change = heading[-1] - heading[0]
    if abs(change) < 0.3:
        return "straight"
    return "left" if change > 0 else "right"


def _shortest(edges: dict[str, list[int]], roads: list[RoadSegment], start: str, end: str) -> tuple[int, ...]:
    queue: deque[tuple[str, tuple[int, ...]]] = deque([(start, ())])
    seen = {start}
    while queue:
        node, path = queue.popleft()
        if node == end:
            return path
        for road in edges.get(node, []):
            following = roads[road].end
            if following not in seen:
                seen.add(following)
                queue.append((following, (*path, road)))
    return ()
