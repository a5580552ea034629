"""What there is to perceive of a scene, and who comes near the ego (VLA-World, section 3.4), by rule.

Who is told of must be visible in the front cameras now. Whether they come near is what they did: that is the
truth which a model learns to foresee. Thresholds are ours, as the paper publishes none.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from looktwice.model.driving.agents import AGENT_KINDS, Agent, AgentKind
from looktwice.model.driving.pdm.geometry import Boxes, boxes_meet
from looktwice.model.driving.reasoning import edge_distances
from looktwice.model.driving.scene import EGO_LENGTH_M, EGO_WIDTH_M, LabelledScene
from looktwice.model.driving.tracks import track_of
from looktwice.model.driving.trajectory import STEP_S, THREE_SECONDS_S, FloatArray, speeds
from looktwice.model.driving.view import visible

MAX_PERCEIVED: Final = 8
"""Agents that are told of, the nearest."""
SAFE_TIMES_S: Final = THREE_SECONDS_S
"""When it is asked who is in the safe zone: the times of the paper's waypoints."""
SAFE_BESIDE_M: Final = 1.0
"""The safe zone reaches so far beyond the ego's sides and its rear: a vehicle in the next lane is outside."""
SAFE_AHEAD_S: Final = 2.0
"""The safe zone reaches so far ahead of the front bumper at the ego's speed: drivers keep two seconds."""

_ROWS: Final = [round(time_s / STEP_S) - 1 for time_s in SAFE_TIMES_S]
_FIELDS: Final = 6
ROW_SIZE: Final = 2 + MAX_PERCEIVED * _FIELDS
"""Numbers of `Perceived.row`."""


@dataclass(frozen=True)
class PerceivedAgent:
    """One of them, now.

    Attributes:
        kind: what it is.
        x_m, y_m: the centre of its box in the ego frame.
        length_m, width_m: of its box.
        near_s: the first of `SAFE_TIMES_S` at which it is in the ego's safe zone; None if never.
    """

    kind: AgentKind
    x_m: float
    y_m: float
    length_m: float
    width_m: float
    near_s: float | None

    @property
    def away_m(self) -> float:
        """From the ego's centre to its own."""
        return math.hypot(self.x_m, self.y_m)


@dataclass(frozen=True)
class Perceived:
    """What there is to perceive.

    Attributes:
        agents: at most `MAX_PERCEIVED`, the nearest first.
        left_m, right_m: from the ego's sides to the edges of the road; infinite where there is none.
    """

    agents: tuple[PerceivedAgent, ...]
    left_m: float
    right_m: float

    def mirrored(self) -> Perceived:
        """The same with left and right swapped."""
        agents = tuple(replace(agent, y_m=-agent.y_m) for agent in self.agents)
        return Perceived(agents, self.right_m, self.left_m)

    def row(self) -> FloatArray:
        """All of it as numbers, float32 [ROW_SIZE]; NaN where there is no agent, or it never comes near."""
        row = np.full(ROW_SIZE, np.nan, np.float32)
        row[:2] = self.left_m, self.right_m
        for told, agent in zip(row[2:].reshape(-1, _FIELDS), self.agents, strict=False):
            near_s = math.nan if agent.near_s is None else agent.near_s
            kind = AGENT_KINDS.index(agent.kind)
            told[:] = kind, agent.x_m, agent.y_m, agent.length_m, agent.width_m, near_s
        return row


def perceived_of_row(row: FloatArray) -> Perceived | None:
    """What `Perceived.row` told; None for a row of NaN, which says that nothing is known."""
    if np.isnan(row[0]):
        return None
    agents = tuple(_agents_of_row(row[2:].reshape(-1, _FIELDS)))
    return Perceived(agents, float(row[0]), float(row[1]))


def _agents_of_row(rows: FloatArray) -> Iterator[PerceivedAgent]:
    for kind, x_m, y_m, length_m, width_m, near_s in rows[~np.isnan(rows[:, 0])].astype(float).tolist():
        when = None if math.isnan(near_s) else near_s
        yield PerceivedAgent(AGENT_KINDS[int(kind)], x_m, y_m, length_m, width_m, when)


def perceived_of(labelled: LabelledScene) -> Perceived | None:
    """What there is to perceive of a labelled scene; None where it has no annotated road."""
    if not labelled.drivable:
        return None
    known = [(agent, track) for agent in labelled.agents if (track := track_of(agent)) is not None]
    tracks = [track for _, track in known]
    zone = _safe_zone(labelled.future)
    agents = [
        PerceivedAgent(
            track.kind, track.x_m, track.y_m, track.length_m, track.width_m, _comes_near(agent, zone)
        )
        for agent, track in known
        if visible(track, tracks)
    ]
    agents.sort(key=lambda agent: agent.away_m)
    return Perceived(tuple(agents[:MAX_PERCEIVED]), *edge_distances(labelled.drivable))


def _safe_zone(future: FloatArray) -> Boxes:
    """The ego's safe zone at `SAFE_TIMES_S`, as it drives along a trajectory [64, 4]."""
    poses = future[_ROWS].astype(np.float64)
    ahead_m = np.maximum(SAFE_BESIDE_M, SAFE_AHEAD_S * speeds(future)[_ROWS])
    length_m = EGO_LENGTH_M + SAFE_BESIDE_M + ahead_m
    heading, middle_m = poses[:, 3], (ahead_m - SAFE_BESIDE_M) / 2
    return Boxes.of(
        poses[:, 0] + middle_m * np.cos(heading),
        poses[:, 1] + middle_m * np.sin(heading),
        heading,
        length_m,
        np.full(len(_ROWS), EGO_WIDTH_M + 2 * SAFE_BESIDE_M),
    )


def _comes_near(agent: Agent, zone: Boxes) -> float | None:
    poses = agent.future[_ROWS].astype(np.float64)
    sides = (np.full(len(_ROWS), side) for side in (agent.length_m, agent.width_m))
    # NaN, where the agent is absent, meets nothing.
    meets = boxes_meet(zone, Boxes.of(*poses.T, *sides))
    return SAFE_TIMES_S[int(meets.argmax())] if meets.any() else None
