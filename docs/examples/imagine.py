"""See what a camera would see if the car did this: python docs/examples/imagine.py [URL [FOLDER]]

Needs a model that imagines and paints: `looktwice serve --checkpoint world-nano`.
"""

import base64
import sys
from pathlib import Path

import numpy as np

from looktwice.clients import PlannerClient
from looktwice.clients.planner import imagine_request
from looktwice.clients.wire import Controls
from looktwice.model.bundled import SCENES
from looktwice.model.driving.scene import FRONT_WIDE
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.trajectory import constant_velocity

url = sys.argv[1] if len(sys.argv) > 1 else "http://127.0.0.1:8000"
folder = Path(sys.argv[2] if len(sys.argv) > 2 else "out")
folder.mkdir(parents=True, exist_ok=True)
scene = next(iter(read_scenes(SCENES, dense=False))).scene
straight_on = constant_velocity(scene.history)
with PlannerClient(url) as planner:
    draw = planner.plan(scene, Controls(n=1)).draws[0]
    asked = {
        "as-it-expects": imagine_request(scene, FRONT_WIDE),
        "as-planned": imagine_request(scene, FRONT_WIDE, trajectory=draw.trajectory, times_s=draw.times_s),
        "straight-on": imagine_request(scene, FRONT_WIDE, trajectory=straight_on),
        "if-it-stood-still": imagine_request(scene, FRONT_WIDE, trajectory=np.zeros_like(straight_on)),
    }
    for name, request in asked.items():
        picture = planner.imagine(request).pictures[0]
        path = folder / f"{name}.png"
        path.write_bytes(base64.b64decode(picture.image))
        print(f"{path}: in half a second at {picture.prediction.x_m:.1f}, {picture.prediction.y_m:.1f} m")
