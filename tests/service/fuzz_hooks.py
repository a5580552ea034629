"""For schemathesis: every other scene gets real pictures and a history, so that requests get past them."""

from __future__ import annotations

from typing import Any

import schemathesis
from pydantic import ValidationError

import clients.wire as wire
from tests.service.serving import body

REAL = body()["scene"]


@schemathesis.hook
def map_body(context: Any, body: Any) -> Any:
    """A body with scenes that can be planned for."""
    if not isinstance(body, dict):
        return body
    requests = body["requests"] if isinstance(body.get("requests"), list) else [body]
    for request in requests:
        scene = request.get("scene") if isinstance(request, dict) else None
        if isinstance(scene, dict) and len(str(request)) % 2 and _is_of_the_schema(scene):
            scene.update({part: REAL[part] for part in ("clips", "history", "route")})
    return body


def _is_of_the_schema(scene: dict[str, Any]) -> bool:
    """What was broken on purpose stays broken."""
    try:
        wire.Scene.model_validate(scene)
    except ValidationError:
        return False
    return True
