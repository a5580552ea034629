"""The example requests of the API description; they can be sent as they are."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

from looktwice.model.driving.images import encode_jpeg
from looktwice.model.driving.scene import CLIP_FRAMES
from looktwice.model.driving.trajectory import HISTORY_STEPS, ROUTE_POINTS, ROUTE_SPACING_M
from looktwice.service.scoring.rule_feedback import plan_id_of


def example_request(cameras: tuple[str, ...]) -> dict[str, Any]:
    """A plan request for a car that drives straight on at 10 m/s, with grey pictures of ``cameras``."""
    picture = base64.b64encode(encode_jpeg(np.full((32, 56, 3), 128, np.uint8), quality=30)).decode()
    return {
        "scene": {
            "scene_id": "straight-on",
            "clips": [{"camera": camera, "images": [picture] * CLIP_FRAMES} for camera in cameras],
            "history": [[float(row), 0.0, 0.0, 0.0] for row in range(1 - HISTORY_STEPS, 1)],
            "route": [[ROUTE_SPACING_M * (point + 1), 0.0] for point in range(ROUTE_POINTS)],
        },
        "controls": {"thinking": "adaptive", "n": 2, "seed": 7},
    }


def example_reflection(cameras: tuple[str, ...]) -> dict[str, Any]:
    """The same scene with a plan to be looked at."""
    asked = example_request(cameras)
    plan = "- longitudinal\n  - 0.0s-2.1s: Keep Speed\n  - 2.1s-6.4s: Accelerate\n"
    return {"scene": asked["scene"], "plan": plan, "controls": asked["controls"]}


def example_refinement(cameras: tuple[str, ...]) -> dict[str, Any]:
    """The same scene behind a slower car, with a draft that keeps its speed."""
    leader = {"x_m": 25.0, "y_m": 0.0, "heading_rad": 0.0, "speed_ms": 3.0, "kind": "vehicle"}
    asked = example_request(cameras)
    return {
        "scene": asked["scene"] | {"tracks": [leader | {"length_m": 4.5, "width_m": 1.9}]},
        "draft": [[5.0 * step, 0.0, 0.0, 0.0] for step in range(1, 9)],
        "feedback": "auto",
        "controls": {"n": 2, "seed": 7},
    }


def example_taught_refinement(cameras: tuple[str, ...]) -> dict[str, Any]:
    """The same with a teacher's sections, and the draft that they were written for."""
    asked = example_refinement(cameras)
    sections = {
        "meta_action": "The plan is to maintain speed and keep lane. The right action is to decelerate.",
        "think_process": "The reasoning overlooks the slower vehicle ahead.",
        "safety_failure": "NC is 0.0: the car hits the vehicle ahead.",
        "efficiency_failure": "EP is 0.00: the metres driven do not count, since the plan is not safe.",
        "correction": "Brake, and stay behind the vehicle ahead.",
    }
    judged = [[x, y, heading] for x, y, _, heading in asked["draft"]]
    return asked | {"feedback": sections | {"plan_id": plan_id_of(judged)}}


def example_imagining(cameras: tuple[str, ...]) -> dict[str, Any]:
    """The same scene, and a camera whose next picture is to be imagined."""
    scene = example_request(cameras)["scene"]
    return {"scene": scene, "camera": "front_left", "controls": {"n": 2, "seed": 7}}


def example_trajectory() -> dict[str, Any]:
    """How the car of the same scene slows down, as a draw of poses every half second tells it."""
    times_s = [0.5 * step for step in range(1, 7)]
    poses = [[round(10.0 * t - t * t, 4), 0.0, 0.0, 0.0] for t in times_s]
    return {"trajectory": poses, "times_s": times_s}


def example_score() -> dict[str, Any]:
    """Two trajectories behind a slower car: one brakes, one does not."""

    def straight(speed: float, brake: float = 0.0) -> list[list[float]]:
        return [[speed * t - brake * t * t / 2, 0.0, 0.0] for t in (0.5 * step for step in range(1, 9))]

    def strip(right: float, left: float) -> list[list[float]]:
        return [[-20.0, right], [100.0, right], [100.0, left], [-20.0, left]]

    return {
        "labels": {
            "ego": {"speed_mps": 8.0},
            "past": [{"heading_rad": 0.0, "acceleration_mps2": 0.0}] * 15,
            "agents": [
                {
                    "agent_id": "leader",
                    "kind": "vehicle",
                    "length_m": 4.5,
                    "width_m": 1.9,
                    "poses": [[30.0 + 0.2 * step, 0.0, 0.0] for step in range(51)],
                }
            ],
            "lanes": [
                {"lane_id": "mine", "ring": strip(-2.0, 2.0), "on_route": True},
                {"lane_id": "beside", "ring": strip(2.0, 6.0), "on_route": True},
            ],
            "intersections": [],
            "drivable": [[strip(-2.0, 6.0)]],
            "red_lights": [],
            "centreline": [[-20.0, 0.0], [100.0, 0.0]],
        },
        "trajectories": [straight(8.0, brake=1.2), straight(8.0)],
        "reference": straight(8.0, brake=1.0),
        "against": "idm",
    }


def example_score_batch() -> dict[str, Any]:
    """The same trajectories by the rules of both versions."""
    asked = example_score()
    return {"requests": [asked | {"version": "v1.1"}, asked | {"version": "v2.2"}]}


def example_feedback() -> dict[str, Any]:
    """The same trajectories with what was thought of the one that does not brake, and what was driven."""
    asked = example_score()
    think = "The road is straight and clear. I keep my speed."
    return {
        "labels": asked["labels"],
        "trajectories": asked["trajectories"],
        "ground_truth": asked["reference"],
        "said": [None, {"think": think}],
        "command": "go straight on",
    }
