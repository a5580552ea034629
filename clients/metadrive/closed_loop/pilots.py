"""Who can drive in the closed loop: whoever makes a trajectory of a scene."""

from __future__ import annotations

import base64
import math
import random
import time
from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np

from looktwice.clients import wire
from looktwice.clients.planner import PlannerClient, imagine_request
from looktwice.clients.wire_imagine import ImagineControls
from looktwice.model.driving.scene import Scene
from looktwice.model.driving.tracks import Track
from looktwice.model.driving.trajectory import FloatArray, constant_velocity

_OVERLOOKED_SHARES: Final = (0.0, 0.0, 0.04, 0.08)
"""Shares of plans at which carelessness begins; an episode has one of them."""
_OVERLOOKED_PLANS: Final = 4
"""Plans in a row that overlook everybody, at most."""
_SEES_STANDING_M: Final = (math.inf, 14.0, 22.0, 32.0)
"""How far off those who stand are seen; an episode has one of them."""
_STANDING_MS: Final = 2.0
"""Who moves more slowly is taken to stand: people walk, too."""


@dataclass(frozen=True, eq=False)
class Planned:
    """What a pilot wants to do.

    Attributes:
        trajectory: float32 [64, 4] in the ego frame.
        others: the draws that were not chosen, float32 [n, 64, 4].
        words: the plan that is followed, in words; empty without one.
        thinking: why it was revised; empty without a second look.
        think_rate: share of the draws that took one; None where nobody thinks.
        milliseconds: that it took.
        late: whether that was more than its deadline.
        imagined: a PNG of what its camera will see in half a second; None where nobody asked for it.
    """

    trajectory: FloatArray
    others: FloatArray
    words: str = ""
    thinking: str = ""
    think_rate: float | None = None
    milliseconds: float = 0.0
    late: bool = False
    imagined: bytes | None = None


class Pilot(Protocol):
    """Makes trajectories."""

    @property
    def name(self) -> str:
        """Of its row in the table."""
        ...

    @property
    def needs_pictures(self) -> bool:
        """Whether it looks at the scene's pictures; if not, nothing is rendered."""
        ...

    def plan(self, scene: Scene) -> Planned:
        """What to do in ``scene``."""
        ...


class ConstantVelocity:
    """Goes straight on at its present speed: the floor."""

    name = "constant velocity"
    needs_pictures = False

    def plan(self, scene: Scene) -> Planned:
        """See `Pilot.plan`."""
        return Planned(constant_velocity(scene.history), np.zeros((0, 64, 4), np.float32))


class Careless:
    """A pilot that overlooks everybody around for up to two seconds now and then, and sees late who stands.

    So it meets what reading pictures wrongly leads to, without any pictures.

    Args:
        pilot: who drives; it has to plan from tracks.
        seed: of the episode: it decides how often, and when. In half of the episodes nobody is overlooked;
            in a quarter those who stand are seen from afar.
    """

    def __init__(self, pilot: Pilot, seed: int) -> None:
        self._pilot, self._random = pilot, random.Random(seed)
        self._share = self._random.choice(_OVERLOOKED_SHARES)
        self._sees_standing_m = self._random.choice(_SEES_STANDING_M)
        self._plans_left = 0
        self.name, self.needs_pictures = pilot.name, pilot.needs_pictures

    def plan(self, scene: Scene) -> Planned:
        """See `Pilot.plan`."""
        if not self._plans_left and self._random.random() < self._share:
            self._plans_left = self._random.randint(1, _OVERLOOKED_PLANS)
        if self._plans_left:
            self._plans_left -= 1
            scene = replace(scene, tracks=())
        assert scene.tracks is not None, "only who plans from tracks can be careless"
        return self._pilot.plan(replace(scene, tracks=tuple(filter(self._sees, scene.tracks))))

    def _sees(self, track: Track) -> bool:
        if abs(track.speed_ms) > _STANDING_MS:
            return True
        return math.hypot(track.x_m, track.y_m) - track.length_m / 2 < self._sees_standing_m


class ServicePilot:
    """Plans through the HTTP API alone, and follows the draw that the others agree with most.

    Args:
        planner: a client of the service.
        name: of its row.
        controls: of every request; the seed goes up by one from plan to plan.
        route: whether the model is told the route.
        tracks: whether it is told the tracks of the objects around.
        format: a response format that the model writes; its first where None.
        imagines: a camera whose next picture is asked for too, for a film; the time of plans is without it.
    """

    needs_pictures = True

    def __init__(
        self,
        planner: PlannerClient,
        name: str,
        controls: wire.Controls,
        *,
        route: bool = True,
        tracks: bool = False,
        format: str | None = None,
        imagines: wire.Camera | None = None,
    ) -> None:
        self._imagines = imagines
        self._planner, self.name, self._controls = planner, name, controls
        self._route, self._tracks, self._format = route, tracks, format
        self._asked = 0

    def plan(self, scene: Scene) -> Planned:
        """See `Pilot.plan`; raises `PlannerError`."""
        controls = self._controls.model_copy(update={"seed": self._controls.seed + self._asked})
        self._asked += 1
        asked = replace(
            scene,
            route=scene.route if self._route else None,
            tracks=scene.tracks if self._tracks else None,
        )
        began_s = time.perf_counter()
        result = self._planner.plan(asked, controls, format=self._format)
        milliseconds = 1000 * (time.perf_counter() - began_s)
        trajectories = np.stack([draw.at_10_hz for draw in result.draws])
        chosen = result.agreed
        draw = result.draws[chosen]
        plan = draw.revised_plan or draw.plan
        return Planned(
            trajectory=trajectories[chosen],
            others=np.delete(trajectories, chosen, axis=0),
            words="" if plan is None else str(plan),
            thinking=draw.thinking or "",
            think_rate=float(np.mean([draw.thinking is not None for draw in result.draws])),
            milliseconds=milliseconds,
            late=controls.deadline_ms is not None and milliseconds > controls.deadline_ms,
            imagined=None if self._imagines is None else self._imagined(asked, self._imagines, controls.seed),
        )

    def _imagined(self, scene: Scene, camera: wire.Camera, seed: int) -> bytes:
        told = self._planner.imagine(imagine_request(scene, camera, ImagineControls(seed=seed)))
        return base64.b64decode(told.pictures[0].image)
