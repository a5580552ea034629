"""NAVSIM's agent in front of the planning service: four instants in, eight poses out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from inspect import signature
from typing import Any, Final

import numpy as np

from looktwice.clients import wire
from looktwice.clients.navsim.agent_input import AgentInput, Cameras, InputError
from looktwice.clients.navsim.history import PERIOD_S, STATUSES, history_of
from looktwice.clients.navsim.reprojection import seen_as
from looktwice.clients.planner import Access, PlannerClient, RetryPolicy
from looktwice.model.driving.cameras import FRONT_CAMERAS, CameraSpec
from looktwice.model.driving.hashing import scene_hash
from looktwice.model.driving.images import encode_jpeg
from looktwice.model.driving.scene import Clip, Scene
from looktwice.model.driving.trajectory import STEP_S, FloatArray

POSES: Final = 8
"""Every half second of four."""
SPECS: Final[Mapping[str, CameraSpec]] = {spec.name: spec for spec in FRONT_CAMERAS}
_EVERY: Final = round(PERIOD_S / STEP_S)
_QUALITY: Final = 95
_SEED_DIGITS: Final = 12
"""Hexadecimal."""


class NavsimMissing(ImportError):
    """NAVSIM is not installed; the text says how to install it."""


class NavsimPlanner:
    """Plans for NAVSIM's agent input, with no need of NAVSIM itself.

    Args:
        planner: a client of the service.
        controls: of every request; what is planned for decides the seed, beside the one given here, so that
            the same input gets the same answer whichever worker asks, and in whichever order.
    """

    def __init__(self, planner: PlannerClient, controls: wire.Controls = wire.Controls()) -> None:
        self._planner, self._controls = planner, controls
        self._card: wire.ModelCard | None = None

    def poses(self, agent_input: AgentInput) -> FloatArray:
        """x, y in m and heading in rad, float32 [8, 3], in 0.5 s to 4.0 s, in the present ego frame.

        Of the draws it is the one that is nearest to all others.

        Raises:
            InputError: instants, cameras or calibrations are missing, or the model does not plan far enough.
            PlannerError: the service gave no plan.
        """
        scene = self.scene(agent_input)
        seed = (self._controls.seed + int(scene_hash(scene)[:_SEED_DIGITS], 16)) % (wire.MAX_SEED + 1)
        result = self._planner.plan(scene, self._controls.model_copy(update={"seed": seed}))
        rows = result.draws[result.agreed].at_10_hz[_EVERY - 1 : _EVERY * POSES : _EVERY]
        if len(rows) < POSES:
            raise InputError(f"its trajectories end after {len(rows)} of the {POSES} poses that NAVSIM wants")
        return np.ascontiguousarray(rows[:, [0, 1, 3]])

    def scene(self, agent_input: AgentInput) -> Scene:
        """The scene that is planned for; NAVSIM knows no route, and its driving command is not one.

        Raises:
            InputError: instants, cameras or calibrations are missing.
            PlannerError: the service does not say which cameras its model looks at.
        """
        if self._card is None:
            self._card = self._planner.models()[0]
        if unknown := [name for name in self._card.cameras if name not in SPECS]:
            raise InputError(f"{self._card.name} looks at {', '.join(unknown)}, which NAVSIM cannot play")
        width, height = self._card.image_size
        if len(agent_input.cameras) != STATUSES:
            raise InputError(f"pictures of four instants are needed, got {len(agent_input.cameras)}")
        clips = []
        for name in self._card.cameras:
            spec = replace(SPECS[name], width=width, height=height)
            clips.append(Clip(name, tuple(_picture(spec, instant) for instant in agent_input.cameras)))
        return Scene("navsim", tuple(clips), history_of(agent_input.ego_statuses))


def make_agent(
    service: str = "http://127.0.0.1:8000",
    n: int = 6,
    thinking: wire.Thinking = "adaptive",
    temperature: float = 1.0,
    deadline_ms: int | None = None,
    timeout_s: float = 120.0,
) -> Any:
    """An agent of NAVSIM's own class; ``_target_`` of an agent's configuration may be this function.

    Args:
        service: URL of a running service.
        n, thinking, temperature, deadline_ms: of every plan.
        timeout_s: for one answer.

    Raises:
        NavsimMissing: NAVSIM is not installed.
    """
    try:
        from navsim.agents.abstract_agent import AbstractAgent
        from navsim.common.dataclasses import SensorConfig, Trajectory
        from nuplan.planning.simulation.trajectory.trajectory_sampling import TrajectorySampling
    except ImportError as error:
        raise NavsimMissing(
            f"the agent runs inside NAVSIM ({error}); install it: github.com/autonomousvision/navsim. "
            "Without it, use NavsimPlanner.poses"
        ) from error

    controls = wire.Controls(n=n, thinking=thinking, temperature=temperature, deadline_ms=deadline_ms)
    sampling = TrajectorySampling(num_poses=POSES, interval_length=PERIOD_S)

    class LookTwiceAgent(AbstractAgent):  # type: ignore[misc]  # NAVSIM brings no types
        """`NavsimPlanner` as NAVSIM knows agents."""

        def __init__(self) -> None:
            # NAVSIM 2 asks for the sampling, NAVSIM 1.1 does not know it.
            asks = "trajectory_sampling" in signature(AbstractAgent.__init__).parameters
            super().__init__(*[sampling] * asks)
            self._client: PlannerClient | None = None
            self._planner: NavsimPlanner | None = None

        def name(self) -> str:
            """Of its row in NAVSIM's results."""
            return "looktwice"

        def get_sensor_config(self) -> Any:
            """Three cameras at all instants."""
            nothing = SensorConfig.build_no_sensors()
            return replace(nothing, cam_f0=True, cam_l0=True, cam_r0=True)

        def initialize(self) -> None:
            """Connect; each worker does it for itself."""
            self._client = PlannerClient(
                service, RetryPolicy(timeout_s=timeout_s), access=Access.from_environment()
            )
            self._planner = NavsimPlanner(self._client, controls)

        def compute_trajectory(self, agent_input: Any) -> Any:
            """Eight poses as NAVSIM's trajectory; raises as `NavsimPlanner.poses` does."""
            if self._planner is None:
                self.initialize()
            assert self._planner is not None
            return Trajectory(self._planner.poses(agent_input), sampling)

        def close(self) -> None:
            """Close the connection; NAVSIM itself lets its workers' end do that."""
            if self._client is not None:
                self._client.close()

    return LookTwiceAgent()


def _picture(spec: CameraSpec, cameras: Cameras) -> bytes:
    return encode_jpeg(seen_as(spec, (cameras.cam_f0, cameras.cam_l0, cameras.cam_r0)), _QUALITY)
