"""What tests of the pipeline build with: scenes, rollouts in a ledger, and a teacher behind a socket."""

from __future__ import annotations

import json
import threading
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse, Response

from looktwice.clients.labelling.ledger import Ledger, StageRun
from looktwice.clients.labelling.rollout import Sampling, config_of, key_of, packed
from looktwice.clients.wire import ModelName
from looktwice.model.driving.plan import parse_plan
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.scene_store import write_scenes
from tests.service.scenes import labelled
from tests.service.scripted_engine import KEEP_ON, SLOW_DOWN

MODEL = ModelName(name="scripted", revision="r1")
GOOD = "A slower vehicle is in my lane. Accelerating would close the gap, so I should slow down."
"""Passes every check for a plan to keep on where slowing down is better."""
LEAKING = "A slower vehicle is in my lane, and the expert slows down."
GO_FASTER = parse_plan(
    "- longitudinal\n  - 0.0s-6.4s: Accelerate\n- lateral\n  - 0.0s-6.4s: Straight\n"
    "- lane\n  - 0.0s-6.4s: Keep Lane\n"
)


def scenes(folder: Path, count: int) -> Path:
    """A scene file with so many scenes, each with its own name."""
    one = labelled("scene")
    path = folder / "scenes.parquet"
    write_scenes(path, (named(one, f"scene-{number:04d}") for number in range(count)))
    return path


def named(one: LabelledScene, scene_id: str) -> LabelledScene:
    return replace(one, scene=replace(one.scene, scene_id=scene_id))


def rolled_out(folder: Path, count: int) -> StageRun:
    """A ledger in which the scenes of `scenes` are rolled out and kept."""
    one = labelled("scene")
    with Ledger(folder) as ledger:
        run = ledger.run("rollout", config_of(MODEL, Sampling(n=2)))
        keys = []
        for number in range(count):
            scene = named(one, f"scene-{number:04d}")
            keys.append(key_of(run, scene))
            ledger.finish(run, keys[-1], scene.scene.scene_id, rollout_record())
        ledger.select(run, [(key, (0,)) for key in keys])
    return run


def rollout_record(free_m: float = 2.0, prefilled_m: float = 0.5, tags: tuple[str, ...] = ()) -> Any:
    trajectory = packed(np.zeros((64, 4), np.float32))
    draw = {"plan": str(KEEP_ON), "plan_iou": 0.5, "think_probability": 0.1, "trajectory": trajectory}
    return {
        "tags": list(tags),
        "expert_plan": str(SLOW_DOWN),
        "free": [
            {"ade_m": free_m, "tokens": 60, **draw},
            {"ade_m": free_m + 1, "tokens": 60, **draw, "plan": str(GO_FASTER)},
        ],
        "prefilled": [{"ade_m": prefilled_m, "tokens": 8}],
    }


@dataclass
class ChatServer:
    """An endpoint for chat completions; ``script`` says what the next answers are, the last one for ever.

    Attributes:
        script: an answer's text; or a status with headers; or bytes, sent as they are.
        asked: bodies, in order.
        keys: the Authorization headers.
    """

    script: list[str | tuple[int, dict[str, str]] | bytes]
    asked: list[dict[str, Any]] = field(default_factory=list)
    keys: list[str | None] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def app(self) -> FastAPI:
        app = FastAPI()

        @app.post("/v1/chat/completions")
        async def complete(request: Request) -> Response:
            self.asked.append(json.loads(await request.body()))
            self.keys.append(request.headers.get("Authorization"))
            with self._lock:
                answer = self.script.pop(0) if len(self.script) > 1 else self.script[0]
            if isinstance(answer, tuple):
                return Response("told why", answer[0], answer[1])
            if isinstance(answer, bytes):
                return Response(answer, media_type="application/json")
            return JSONResponse(completion(answer))

        return app


def completion(text: str | None, finish_reason: str = "stop") -> dict[str, Any]:
    return {
        "id": "chatcmpl-1",
        "object": "chat.completion",
        "choices": [
            {
                "index": 0,
                "message": {"role": "assistant", "content": text},
                "finish_reason": finish_reason,
            }
        ],
        "usage": {"prompt_tokens": 1000, "completion_tokens": 50, "total_tokens": 1050},
    }


def without_future(file: Path, scene_id: str) -> None:
    """Take the expert's future from one scene of a file."""
    table = pq.read_table(file)
    rows = table.select(["scene_id", "future"]).to_pylist()
    place = table.schema.get_field_index("future")
    futures = [None if row["scene_id"] == scene_id else row["future"] for row in rows]
    column = pa.array(futures, table.schema.field(place).type)
    table = table.set_column(place, table.schema.field(place), column)
    pq.write_table(table, file, write_page_checksum=True)
