"""For schemathesis: every other scene gets real pictures and a history, so that requests get past them.

Chats too, and bodies go out in msgpack as well.
"""

from __future__ import annotations

from typing import Any

import msgpack
import schemathesis
from pydantic import ValidationError

import looktwice.clients.wire as wire
from looktwice.clients.wire_feedback import FeedbackRequest
from looktwice.clients.wire_imagine import ImagineRequest
from looktwice.clients.wire_refine import RefineRequest
from looktwice.clients.wire_scores import ScoreRequest
from looktwice.service.openai.chat_requests import ChatRequest
from looktwice.service.routes.request_examples import example_feedback, example_refinement, example_score
from tests.service.serving import body

REAL = body()["scene"]
SCORED = {"scene_id": None, **example_score()}
JUDGED = {"scene_id": None, **example_feedback()}
_JUDGED_ONLY = {"said", "threshold", "mode", "command", "ground_truth"}
DRAFT = example_refinement(("front_wide_120",))["draft"]
REFINES = "elf_vla_refine"
IMAGINES = "vla_world"
ATTEMPT = {"trajectory": DRAFT, "times_s": [0.5 * step for step in range(1, 9)], "feedback": "Brake."}
DRIVEN = {"motion": None, "trajectory": DRAFT, "times_s": ATTEMPT["times_s"]}
ATTEMPTED = {"format": REFINES, "attempt": ATTEMPT}
PICTURES = [
    {"type": "image_url", "image_url": {"url": f"data:image/jpeg;base64,{image}"}}
    for clip in REAL["clips"]
    for image in clip["images"]
]
_LARGEST = 2**63


@schemathesis.hook
def map_body(context: Any, body: Any) -> Any:
    """A body with scenes that can be planned for."""
    if not isinstance(body, dict):
        return body
    if "messages" in body:
        if len(str(body)) % 2 and _is_of_the_schema(ChatRequest, body):
            body["messages"] = [{"role": "user", "content": PICTURES}]
        return body
    requests = body["requests"] if isinstance(body.get("requests"), list) else [body]
    for request in requests:
        if isinstance(request, dict) and len(str(request)) % 2 and _is_of_the_schema(ScoreRequest, request):
            request.update(SCORED)
        if isinstance(request, dict) and "attempt" in request and len(str(request)) % 2:
            request.update(ATTEMPTED if _is_of_the_schema(wire.PlanRequest, request) else {})
        if isinstance(request, dict) and "draft" in request and len(str(request)) % 2:
            request.update({"draft": DRAFT} if _is_of_the_schema(RefineRequest, request) else {})
        if isinstance(request, dict) and "camera" in request and len(str(request)) % 2:
            request.update(DRIVEN if _is_of_the_schema(ImagineRequest, request) else {})
        if isinstance(request, dict) and _JUDGED_ONLY & request.keys() and len(str(request)) % 2:
            request.update(JUDGED if _is_of_the_schema(FeedbackRequest, request) else {})
        scene = request.get("scene") if isinstance(request, dict) else None
        if isinstance(scene, dict) and len(str(request)) % 2 and _is_of_the_schema(wire.Scene, scene):
            scene.update({part: REAL[part] for part in ("clips", "history", "route")})
    return body


@schemathesis.serializer("application/msgpack")
def packed(context: Any, value: Any) -> bytes:
    """What is to be sent, packed."""
    return bytes(msgpack.packb(_within_bounds(value)))


def _within_bounds(value: Any) -> Any:
    """Numbers that msgpack has no form for as floats."""
    if isinstance(value, dict):
        return {name: _within_bounds(of) for name, of in value.items()}
    if isinstance(value, list):
        return [_within_bounds(of) for of in value]
    if isinstance(value, int) and not -_LARGEST <= value < 2 * _LARGEST:
        return float(value) if abs(value) < 2**1000 else float("inf")
    return value


def _is_of_the_schema(model: type[Any], value: dict[str, Any]) -> bool:
    """What was broken on purpose stays broken."""
    try:
        model.model_validate(value)
    except ValidationError:
        return False
    return True
