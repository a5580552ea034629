"""Have another planner's plan looked at: python docs/examples/reflect_on_another_plan.py [URL]

Here the other planner is careless: it accelerates straight on, whatever is ahead.
"""

import sys

from looktwice.clients import PlannerClient
from looktwice.clients.wire import ReflectControls
from looktwice.model.bundled import SCENES
from looktwice.model.driving.plan import parse_plan
from looktwice.model.driving.scene_store import read_scenes

careless = parse_plan(
    "- longitudinal\n  - 0.0s-6.4s: Accelerate\n"
    "- lateral\n  - 0.0s-6.4s: Straight\n"
    "- lane\n  - 0.0s-6.4s: Keep Lane\n"
)
with PlannerClient(sys.argv[1] if len(sys.argv) > 1 else "http://127.0.0.1:8000") as planner:
    for labelled in read_scenes(SCENES, dense=False):
        result = planner.reflect(labelled.scene, careless, ReflectControls(n=1, thinking="always"))
        look, scene_id = result.draws[0], labelled.scene.scene_id
        print(f"\n{scene_id}: think probability {result.think_probability:.2f}, {look.decision}")
        if look.thinking:
            print(f"  {look.thinking}")
        for change in look.changes:
            print(f"  {change.start_s:.1f}-{change.end_s:.1f} s: {change.proposed} -> {change.revised}")
