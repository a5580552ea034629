"""The example requests of the API description; they can be sent as they are."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

from model.driving.images import encode_jpeg
from model.driving.scene import CLIP_FRAMES
from model.driving.trajectory import HISTORY_STEPS, ROUTE_POINTS, ROUTE_SPACING_M


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
