"""Plan for a bundled scene: python docs/examples/plan_in_ten_lines.py [URL]"""

import sys

from looktwice.clients import PlannerClient
from looktwice.clients.wire import Controls
from looktwice.model.bundled import SCENES
from looktwice.model.driving.scene_store import read_scenes

scene = next(iter(read_scenes(SCENES, dense=False))).scene
with PlannerClient(sys.argv[1] if len(sys.argv) > 1 else "http://127.0.0.1:8000") as planner:
    answer = planner.plan(scene, Controls(n=6))
for draw in answer.draws:
    x, y, _, _ = draw.trajectory[-1]
    print(f"{draw.branch} think probability {draw.think_probability:.2f}: in 6.4 s at {x:.1f}, {y:.1f} m")
agreed = answer.draws[answer.agreed]
print(f"Draw {agreed.index} lies nearest to the others:\n{agreed.revised_plan or agreed.plan}")
