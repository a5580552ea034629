"""For schemathesis: every picture, path and plan is one that can be planned for, or wrong as a whole.

Its coverage phase tries the bounds of each value one by one. Of lists of lists of poses that takes hours, and
nothing gets past the first pose. Here such a list is one value. So the phase tries all around it, in requests
that are served otherwise: fields left out, added, null, of another type, and at their bounds.
"""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import schemathesis

from looktwice.model.driving.scene import FRONT_WIDE
from looktwice.service.routes.request_examples import example_score
from tests.service import fuzz_hooks
from tests.service.fuzz_hooks import ATTEMPT, DRAFT, PICTURES, REAL
from tests.service.scripted_engine import KEEP_ON, SLOW_DOWN

_SCORE = example_score()
_LABELS = _SCORE["labels"]
_RING = _LABELS["lanes"][0]["ring"]
_OUTCOME = {"fails": ["collision"], "collided_s": 2.0, "hit": "standing vehicle"}
_PLAN_OUTCOME = "#/components/schemas/PlanOutcome"


def _one(*values: Any) -> dict[str, Any]:
    return {"enum": list(values)}


def _track(word: str) -> dict[str, Any]:
    fields = {"start_s": _one(0.0), "end_s": _one(6.4), "word": _one(word)}
    action = {
        "type": "object",
        "properties": fields,
        "required": list(fields),
        "additionalProperties": False,
    }
    return {"anyOf": [{"type": "array", "items": action, "minItems": 1, "maxItems": 64}, {"type": "null"}]}


WHOLE: dict[tuple[str, str], dict[str, Any]] = {
    ("Clip", "camera"): _one(FRONT_WIDE),
    ("Clip", "images"): _one(REAL["clips"][0]["images"]),
    ("Scene", "history"): _one(REAL["history"]),
    ("Scene", "route"): _one(REAL["route"], None),
    ("Extras", "history"): _one(REAL["history"], None),
    ("Extras", "route"): _one(REAL["route"], None),
    ("Controls", "prefill"): _one(str(KEEP_ON), None),
    ("Extras", "prefill"): _one(str(KEEP_ON), None),
    ("Tracks", "longitudinal"): _track("Keep Speed"),
    ("Tracks", "lateral"): _track("Straight"),
    ("Tracks", "lane"): _track("Keep Lane"),
    ("PlanRequest", "format"): _one("cf_vla"),
    ("Attempt", "trajectory"): _one(ATTEMPT["trajectory"]),
    ("Attempt", "times_s"): _one(ATTEMPT["times_s"], None),
    ("RefineRequest", "draft"): _one(DRAFT),
    ("ImagineRequest", "trajectory"): _one(DRAFT, None),
    ("ImagineRequest", "times_s"): _one(ATTEMPT["times_s"], None),
    ("ReflectRequest", "format"): _one("cf_vla"),
    ("Extras", "format"): _one("cf_vla"),
    ("ChatRequest", "model"): _one(""),
    ("Message", "role"): _one("user"),
    ("Message", "content"): _one(PICTURES[:4]),
    ("Agent", "kind"): _one("vehicle"),
    ("Agent", "poses"): _one([[10.0, 0.0, 0.0]] * 80),
    ("Annotations", "lane_lines"): _one([[[0.0, 0.0], [50.0, 0.0]]]),
    ("LabelRequest", "predicted_plan"): _one(str(KEEP_ON)),
    ("LabelRequest", "expert_plan"): _one(str(SLOW_DOWN)),
    ("LabelRequest", "outcome"): {"anyOf": [_one(_OUTCOME), {"$ref": _PLAN_OUTCOME}, {"type": "null"}]},
    ("ScoredAgent", "poses"): _one(_LABELS["agents"][0]["poses"]),
    ("ScoredLane", "ring"): _one(_RING),
    ("ClosedLane", "ring"): _one(_RING),
    ("Labels", "intersections"): _one([], None),
    ("Labels", "drivable"): _one(_LABELS["drivable"], None),
    ("Labels", "centreline"): _one(_LABELS["centreline"], None),
    ("PreviousPlan", "trajectory"): _one(_SCORE["reference"]),
    ("ScoreRequest", "scene_id"): _one(None),
    ("ScoreRequest", "trajectories"): _one(_SCORE["trajectories"]),
    ("ScoreRequest", "reference"): _one(_SCORE["reference"], None),
    ("ScoreRequest", "human"): _one(_SCORE["reference"], None),
    ("FeedbackRequest", "trajectories"): _one(_SCORE["trajectories"]),
    **{
        ("FeedbackRequest", field): _one(_SCORE["reference"], None)
        for field in ("reference", "human", "ground_truth")
    },
}
"""What the description says instead, by the title of a schema and the name of a field in it."""

packed = fuzz_hooks.packed


@schemathesis.hook
def before_load_schema(context: Any, raw_schema: dict[str, Any]) -> None:
    """Put them there; answers tell plans by a schema that requests share, and theirs stays."""
    schemas = raw_schema["components"]["schemas"]
    told = deepcopy(schemas["Tracks"])
    _put(schemas)
    schemas["Plan"]["properties"]["tracks"] = told


def _put(node: Any) -> None:
    if isinstance(node, list):
        for part in node:
            _put(part)
    elif isinstance(node, dict):
        if isinstance(fields := node.get("properties"), dict):
            for name, described in list(fields.items()):
                fields[name] = WHOLE.get((str(node.get("title")), name), described)
        for part in node.values():
            _put(part)
