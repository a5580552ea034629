"""Drives many sessions through one planner, which batches them. No gRPC here."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

import numpy as np

from looktwice.clients import wire
from looktwice.clients.alpasim.errors import (
    Draining,
    EgodriverError,
    SessionExists,
    TooEarly,
    TooManySessions,
    UnknownSession,
)
from looktwice.clients.alpasim.frames import fitted
from looktwice.clients.alpasim.session import CAMERAS, PlanInput, Session
from looktwice.clients.answers import PlanResult
from looktwice.model.driving.scene import Scene
from looktwice.model.driving.trajectory import FloatArray

TRANSPORT_MS: Final = 10
"""Of a drive's time, kept back for the way to the planner and back."""


class Planner(Protocol):
    """Who plans: `looktwice.clients.planner.AsyncPlannerClient`, over a socket or in this process."""

    async def plan(self, scene: Scene, controls: wire.Controls) -> PlanResult:
        """Plan for ``scene``; raises `looktwice.clients.answers.PlannerError`."""
        ...

    async def models(self) -> list[wire.ModelCard]:
        """The models that plan; raises `looktwice.clients.answers.PlannerError`."""
        ...


@dataclass(frozen=True)
class DriverConfig:
    """How the driver drives.

    Attributes:
        cameras: our cameras with the logical ids that play them.
        controls: of every plan; the seed is that of the session, and goes up by one from drive to drive.
        route: whether the model is told the route.
        deadline_ms: of each drive, from its arrival, or less where its caller waits less; None for none.
        max_sessions: open at once.
        idle_s: a session that nothing was heard of for so long gives way when there is no room.
    """

    cameras: Mapping[str, str] = field(default_factory=lambda: dict(CAMERAS))
    controls: wire.Controls = field(default_factory=wire.Controls)
    route: bool = True
    deadline_ms: int | None = 100
    max_sessions: int = 64
    idle_s: float = 600.0


@dataclass(frozen=True, eq=False)
class Driven:
    """What a drive came to.

    Attributes:
        moment: what was planned for.
        trajectories: float32 [n, 64, 4], all draws in the ego frame.
        chosen: which of them is driven: the one that is nearest to all others.
        debug: what else is worth knowing, JSON-like.
    """

    moment: PlanInput
    trajectories: FloatArray
    chosen: int
    debug: dict[str, Any]


class Egodriver:
    """Sessions in front of one planner. One event loop owns it.

    Args:
        planner: plans for all sessions.
        card: the model behind it; its cameras must all be played.
        config: see `DriverConfig`.

    Raises:
        EgodriverError: no logical id is known for a camera that the model needs.
    """

    def __init__(self, planner: Planner, card: wire.ModelCard, config: DriverConfig = DriverConfig()) -> None:
        if missing := [camera for camera in card.cameras if camera not in config.cameras]:
            raise EgodriverError(
                f"{card.name} looks at {', '.join(missing)}: name who plays it with --camera OURS=LOGICAL_ID"
            )
        self.card = card
        self._planner, self._config = planner, config
        self._cameras = {camera: config.cameras[camera] for camera in card.cameras}
        self._size = (card.image_size[0], card.image_size[1])
        self._sessions: dict[str, Session] = {}
        self._heard_s: dict[str, float] = {}
        self._draining = False
        self._empty = asyncio.Event()
        self._empty.set()

    @property
    def sessions(self) -> int:
        """How many are open."""
        return len(self._sessions)

    def start_session(self, session_id: str, seed: int, declared: set[str]) -> None:
        """Open a session of a vehicle with the ``declared`` cameras; raises `EgodriverError`."""
        if self._draining:
            raise Draining("this driver is going away; start the session with another one")
        if session_id in self._sessions:
            raise SessionExists(f"session {session_id} is open already")
        session = Session(session_id, seed, declared, self._cameras)
        self._make_room()
        self._sessions[session_id] = session
        self._heard_s[session_id] = time.monotonic()
        self._empty.clear()

    def close_session(self, session_id: str) -> bool:
        """Forget a session; whether there was one."""
        known = self._sessions.pop(session_id, None) is not None
        self._heard_s.pop(session_id, None)
        if not self._sessions:
            self._empty.set()
        return known

    def session(self, session_id: str) -> Session:
        """An open session; raises `UnknownSession`."""
        if session_id not in self._sessions:
            raise UnknownSession(f"unknown session {session_id}; start_session comes first")
        self._heard_s[session_id] = time.monotonic()
        return self._sessions[session_id]

    async def add_picture(self, session_id: str, logical_id: str, time_us: int, encoded: bytes) -> None:
        """Keep a picture in the model's size; raises `EgodriverError`."""
        session = self.session(session_id)
        if session.uses(logical_id):
            # On a thread: pictures of one session must not hold up the drives of others.
            session.add_picture(logical_id, time_us, await asyncio.to_thread(fitted, encoded, self._size))

    async def drive(self, session_id: str, now_us: int, budget_ms: float | None = None) -> Driven | None:
        """What to do from ``now_us`` on; None while too little was seen to plan.

        Args:
            session_id: an open session.
            now_us: on the runtime's clock.
            budget_ms: that the caller still waits; None where it waits as long as it takes.

        Raises:
            EgodriverError: the session is unknown, or its history is bad.
            PlannerError: the planner gave no plan.
        """
        began_s = time.perf_counter()
        session = self.session(session_id)
        try:
            moment = session.moment(now_us)
        except TooEarly:
            return None
        controls = self._config.controls.model_copy(
            update={
                "seed": (session.seed + session.drives) % wire.MAX_SEED,
                "deadline_ms": self._deadline_ms(budget_ms),
            }
        )
        session.drives += 1
        scene = moment.scene
        if not self._config.route:
            scene = Scene(scene.scene_id, scene.clips, scene.history)
        result = await self._planner.plan(scene, controls)
        trajectories = np.stack([draw.at_10_hz for draw in result.draws])
        chosen = result.agreed
        debug = _debug(result, chosen, controls, 1000 * (time.perf_counter() - began_s))
        return Driven(moment, trajectories, chosen, debug | {"seen": session.counts()})

    async def drain(self, timeout_s: float) -> None:
        """Take no new sessions, and wait until the open ones are closed, at most so long."""
        self._draining = True
        try:
            await asyncio.wait_for(self._empty.wait(), timeout_s)
        except TimeoutError:
            return

    def _make_room(self) -> None:
        if len(self._sessions) < self._config.max_sessions:
            return
        longest_ago = min(self._heard_s, key=lambda session_id: self._heard_s[session_id])
        if time.monotonic() - self._heard_s[longest_ago] < self._config.idle_s:
            raise TooManySessions(f"{len(self._sessions)} sessions are open; at most so many are taken")
        self.close_session(longest_ago)

    def _deadline_ms(self, budget_ms: float | None) -> int | None:
        if self._config.deadline_ms is None:
            return None
        least_ms = self._config.deadline_ms if budget_ms is None else min(self._config.deadline_ms, budget_ms)
        return max(1, round(least_ms) - TRANSPORT_MS)


def _debug(result: PlanResult, chosen: int, controls: wire.Controls, drive_ms: float) -> dict[str, Any]:
    draw = result.draws[chosen]
    return {
        "model": f"{result.model.name} {result.model.revision}",
        "request_id": result.request_id,
        "draws": len(result.draws),
        "chosen": chosen,
        "plan": None if draw.plan is None else str(draw.plan),
        "branch": draw.branch,
        "think_probability": draw.think_probability,
        # The name under which alpasim's evaluation looks for it.
        "reasoning_text": draw.thinking,
        "revised_plan": None if draw.revised_plan is None else str(draw.revised_plan),
        "think_rate": float(np.mean([each.thinking is not None for each in result.draws])),
        "seed": controls.seed,
        "deadline_ms": controls.deadline_ms,
        "deadline_met": None if result.deadline is None else result.deadline.met,
        "cut": draw.cut,
        "engine_ms": result.timing.engine_ms,
        "drive_ms": round(drive_ms, 2),
    }
