"""NAVSIM's own scorer on our worlds, for comparison: from a checkout, without its data and without torch.

It runs in an environment that has what NAVSIM needs (numpy < 2, shapely < 2.1, scipy, pandas, ...) but for
torch, pytorch-lightning, ray and hydra, which NAVSIM imports here and does not use.
"""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, Final

import numpy as np

from looktwice.model.driving.pdm.comfort import Version
from looktwice.model.driving.pdm.world import LONG_STEPS, STEPS, Array, World

_UNUSED: Final = ("torch", "pytorch_lightning", "ray", "hydra", "omegaconf")
_ACTORS: Final = "nuplan.common.actor_state"
_SIMULATION: Final = "nuplan.planning.simulation"
_PLANNER: Final = "navsim.planning.simulation.planner.pdm_planner"
_NAMES: Final = {
    "Agent": f"{_ACTORS}.agent",
    "EgoState": f"{_ACTORS}.ego_state",
    "OrientedBox": f"{_ACTORS}.oriented_box",
    "SceneObjectMetadata": f"{_ACTORS}.scene_object",
    "StaticObject": f"{_ACTORS}.static_object",
    "StateSE2": f"{_ACTORS}.state_representation",
    "StateVector2D": f"{_ACTORS}.state_representation",
    "TimePoint": f"{_ACTORS}.state_representation",
    "TrackedObjects": f"{_ACTORS}.tracked_objects",
    "TrackedObjectType": f"{_ACTORS}.tracked_objects_types",
    "get_pacifica_parameters": f"{_ACTORS}.vehicle_parameters",
    "SemanticMapLayer": "nuplan.common.maps.maps_datatypes",
    "DetectionsTracks": f"{_SIMULATION}.observation.observation_type",
    "InterpolatedTrajectory": f"{_SIMULATION}.trajectory.interpolated_trajectory",
    "TrajectorySampling": f"{_SIMULATION}.trajectory.trajectory_sampling",
    "transform_trajectory": "navsim.evaluate.pdm_score",
    "get_trajectory_as_array": "navsim.evaluate.pdm_score",
    "Trajectory": "navsim.common.dataclasses",
    "PDMObservation": f"{_PLANNER}.observation.pdm_observation",
    "PDMDrivableMap": f"{_PLANNER}.observation.pdm_occupancy_map",
    "PDMScorer": f"{_PLANNER}.scoring.pdm_scorer",
    "PDMScorerConfig": f"{_PLANNER}.scoring.pdm_scorer",
    "PDMSimulator": f"{_PLANNER}.simulation.pdm_simulator",
    "PDMPath": f"{_PLANNER}.utils.pdm_path",
}


class _StandIn(ModuleType):
    """Has whatever is asked of it."""

    __path__: list[str] = []  # noqa: RUF012  # as modules have it

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _Nothing


class _Nothing:
    """Can be subclassed, called, indexed and asked for anything; does nothing."""

    def __init__(self, *_: object, **__: object) -> None: ...

    def __class_getitem__(cls, _: object) -> type[_Nothing]:
        return cls

    def __call__(self, *given: Any, **__: object) -> Any:
        return given[0] if given else self

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _Nothing


class _NavsimFinder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    def find_spec(self, name: str, path: object, target: object = None) -> Any:
        if name.split(".")[0] in _UNUSED:
            return importlib.machinery.ModuleSpec(name, self, is_package=True)
        return None

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType:
        return _StandIn(spec.name)

    def exec_module(self, module: ModuleType) -> None: ...


class NavsimScorer:
    """The simulator and the scorer of one version.

    Args:
        version: which one the checkout holds.
        folders: what holds the packages ``navsim`` and ``nuplan``.
    """

    def __init__(self, version: Version, folders: Sequence[Path]) -> None:
        sys.path[:0] = [str(folder) for folder in folders]
        finder = _NavsimFinder()
        sys.meta_path.insert(0, finder)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = {name: getattr(importlib.import_module(place), name) for name, place in _NAMES.items()}
        sys.meta_path.remove(finder)
        # SciPy would take the stand-in for PyTorch.
        for name in [each for each in sys.modules if each.split(".")[0] == "torch"]:
            del sys.modules[name]
        self._names: Any = SimpleNamespace(**found)
        self._version = version
        self._sampling = self._names.TrajectorySampling(num_poses=STEPS, interval_length=0.1)

    def simulate(self, world: World, plans: Sequence[Array]) -> Array:
        """States [n, 41, 11] of plans of the rear axle, [8, 3] or [64, 3] each."""
        names, ego = self._names, self._ego(world.ego)
        rows = []
        for plan in plans:
            sampling = names.TrajectorySampling(
                num_poses=len(plan), interval_length=0.5 if len(plan) == 8 else 0.1
            )
            moved = names.transform_trajectory(names.Trajectory(plan, sampling), ego)
            rows.append(names.get_trajectory_as_array(moved, self._sampling, ego.time_point))
        references = np.stack(rows)[:, : STEPS + 1]
        states: Array = names.PDMSimulator(self._sampling).simulate_proposals(references, ego)
        return states

    def score(self, world: World, states: Array) -> Array:
        """Sub-scores and score of each plan after the first one, which is the reference: [n - 1, 9].

        Columns: collisions, drivable area, driving direction, traffic lights, progress, time to collision,
        lane keeping, comfort, score without extended comfort; NaN for what the version has not.
        """
        names = self._names
        scorer = names.PDMScorer(self._sampling, names.PDMScorerConfig())
        assert world.centreline is not None
        line = names.PDMPath([names.StateSE2(*map(float, point), 0.0) for point in world.centreline])
        route = [lane.lane_id for lane in world.lanes or () if lane.on_route]
        given = (states, self._observation(world), line, route, self._map(world))
        more = () if self._version == "v1.1" else (None, None, self._past(world))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            scorer.score_proposals(*given, *more)
        return np.array([self._beside_reference(scorer, plan) for plan in range(1, len(states))])

    def extended_comfort(self, states: Array, previous: Array) -> Array:
        """Whether plans go on as ``previous`` [41, 11] of half a second ago began: [n], 0 or 1."""
        comfort = importlib.import_module(f"{_PLANNER}.scoring.pdm_comfort_metrics")
        before = np.repeat(previous[None, 5:], len(states), axis=0)
        seconds = np.arange(STEPS - 4) * 0.1
        return np.asarray(comfort.ego_is_two_frame_extended_comfort(states[:, :-5], before, seconds), float)

    def _ego(self, state: Array, seconds: float = 0.0) -> Any:
        names = self._names
        x, y, heading, vx, vy, ax, ay, steering, rate, yaw, yaw_acceleration = map(float, state)
        return names.EgoState.build_from_rear_axle(
            names.StateSE2(x, y, heading),
            names.StateVector2D(vx, vy),
            names.StateVector2D(ax, ay),
            steering,
            names.TimePoint(round(seconds * 1e6)),
            names.get_pacifica_parameters(),
            angular_vel=yaw,
            angular_accel=yaw_acceleration,
            tire_steering_rate=rate,
        )

    def _past(self, world: World) -> Any:
        if world.past is None:
            return None
        rows = [*world.past, world.ego]
        return self._names.InterpolatedTrajectory(
            [self._ego(row, 0.1 * number) for number, row in enumerate(rows)]
        )

    def _observation(self, world: World) -> Any:
        first = self._version == "v1.1"
        options = {} if first else {"extend_observation_for_ttc": False}
        made = self._names.PDMObservation(
            self._sampling, self._sampling, 100, observation_sample_res=1, **options
        )
        count = LONG_STEPS + 1 if first else STEPS + 1
        if not first:
            made._occupancy_maps_tl = [self._red(world, step) for step in range(count)]
        made.update_detections_tracks([self._detections(world, step) for step in range(count)])
        return made

    def _red(self, world: World, step: int) -> tuple[list[str], Any]:
        red = [light for light in world.lights or () if light.red is None or light.red[step]]
        return [f"red_light_{light.light_id}" for light in red], _polygons(
            light.area.rings[0] for light in red
        )

    def _detections(self, world: World, step: int) -> Any:
        names, found = self._names, []
        for track in world.tracks or ():
            pose = track.poses[step]
            if np.isnan(pose[0]):
                continue
            box = names.OrientedBox(names.StateSE2(*map(float, pose)), track.length_m, track.width_m, 1.6)
            about = names.SceneObjectMetadata(int(step * 1e5), track.track_id, None, track.track_id)
            if track.is_agent:
                speed = names.StateVector2D(track.first_speed_mps, 0.0)
                found.append(names.Agent(names.TrackedObjectType.VEHICLE, box, speed, about))
            else:
                found.append(names.StaticObject(names.TrackedObjectType.BARRIER, box, about))
        return names.DetectionsTracks(names.TrackedObjects(found))

    def _map(self, world: World) -> Any:
        layer = self._names.SemanticMapLayer
        parts = [(f"block_{n}", layer.ROADBLOCK, area) for n, area in enumerate(world.drivable or ())]
        parts += [(lane.lane_id, layer.LANE, lane.area) for lane in world.lanes or ()]
        parts += [
            (f"crossing_{n}", layer.INTERSECTION, area) for n, area in enumerate(world.intersections or ())
        ]
        tokens, kinds, areas = zip(*parts, strict=True)
        return self._names.PDMDrivableMap(
            list(tokens), list(kinds), _polygons(area.rings[0] for area in areas)
        )

    def _beside_reference(self, scorer: Any, plan: int) -> list[float]:
        """NAVSIM's own sum of one plan and the reference, as its evaluation pairs them."""
        multi, weighted, raw = scorer._multi_metrics, scorer._weighted_metrics, scorer._progress_raw
        both, first = [0, plan], self._version == "v1.1"
        scorer._multi_metrics, scorer._weighted_metrics = multi[:, both].copy(), weighted[:, both].copy()
        scorer._progress_raw = raw[both]
        total = (scorer._aggregate_scores if first else scorer._aggregate_pdm_scores)()[1]
        m, w = scorer._multi_metrics[:, 1], scorer._weighted_metrics[:, 1]
        scorer._multi_metrics, scorer._weighted_metrics, scorer._progress_raw = multi, weighted, raw
        nan = float("nan")
        if first:
            return [m[0], m[1], w[3], nan, w[0], w[1], nan, w[2], total]
        return [m[0], m[1], m[3], m[2], w[0], w[1], w[2], w[3], total]


def _polygons(rings: Any) -> Any:
    from shapely.geometry import Polygon

    made = [Polygon(ring) for ring in rings]
    polygons = np.empty(len(made), dtype=object)
    polygons[:] = made
    return polygons
