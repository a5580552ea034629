"""What Ray and the application make of Serve files, as JSON; by itself, since importing Serve warns."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import ray
import yaml
from pydantic import ValidationError
from ray.serve.schema import ServeDeploySchema

from looktwice.deploy.ray import app


def read(path: str) -> dict[str, Any]:
    told = yaml.safe_load(Path(path).read_text())
    (application,) = told["applications"]
    app.application(application["args"])
    try:
        app.application(application["args"] | {"row": 64})
    except ValidationError as error:
        refused = error.errors()[0]["loc"]
    try:
        app.Planning(app.Arguments())
    except ValueError as error:
        closed = str(error)
    kept = ServeDeploySchema.model_validate(told).model_dump(exclude_unset=True)
    return {"ray": ray.__version__, "kept": kept, "refused": refused, "closed": closed}


if __name__ == "__main__":
    print(json.dumps([read(path) for path in sys.argv[1:]]))
