"""A real server on a free port, and what it takes to talk to it."""

from __future__ import annotations

import asyncio
import base64
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic

import httpx
from prometheus_client import CollectorRegistry
from prometheus_client.parser import text_string_to_metric_families
from typing_extensions import TypeVar

from looktwice.clients.labelling.teachers.rules import RuleTeacher
from looktwice.clients.labelling.teachers.teacher import Teacher
from looktwice.model.driving.scene import Scene
from looktwice.model.engines.engine import Engine
from looktwice.service.app import create_app
from looktwice.service.http.server import make_server
from looktwice.service.operations.settings import Settings
from tests.service.scenes import scene
from tests.service.scripted_engine import ScriptedEngine
from tests.sockets import PATIENCE_S, listening
from tests.waiting import until

ServedEngine = TypeVar("ServedEngine", bound=Engine, default=ScriptedEngine)


@dataclass
class Served(Generic[ServedEngine]):
    """A running service."""

    engine: ServedEngine
    url: str
    http: httpx.Client
    loop: asyncio.AbstractEventLoop

    def in_loop(self, call: Callable[[], object]) -> None:
        """Run ``call`` in the server's event loop, which owns the engine."""
        done = threading.Event()

        def run() -> None:
            call()
            done.set()

        self.loop.call_soon_threadsafe(run)
        assert done.wait(PATIENCE_S)

    def until(self, condition: Callable[[], bool]) -> None:
        """Wait for what must come; fails when it does not."""
        until(condition)

    def until_ready(self) -> None:
        self.until(lambda: self.http.get("/readyz").status_code == 200)

    def metric(self, name: str, /, **labels: str) -> float:
        """The value of one sample; 0 where there is none yet."""
        for family in text_string_to_metric_families(self.http.get("/metrics").text):
            for sample in family.samples:
                if sample.name == name and labels.items() <= sample.labels.items():
                    return sample.value
        return 0.0


@contextmanager
def serve(
    engine: ServedEngine,
    settings: Settings,
    *,
    wait: bool = True,
    teacher: Teacher = RuleTeacher(),
    port: int = 0,
    load: Callable[[Path], Engine] | None = None,
    headers: dict[str, str] | None = None,
) -> Iterator[Served[ServedEngine]]:
    """Serve ``engine`` over a real socket until the block ends; ``headers`` come with every request."""
    app = create_app(engine, settings, CollectorRegistry(), teacher, load)
    with (
        listening(app, port, make_server(app, settings)) as (url, loop),
        httpx.Client(base_url=url, timeout=PATIENCE_S, headers=headers) as http,
    ):
        assert http.get("/healthz").status_code in (200, 503)
        served = Served(engine, url, http, loop)
        if wait:
            served.until_ready()
        yield served


def body(of: Scene | None = None, **controls: Any) -> dict[str, Any]:
    """A good request body; tests break it in one place."""
    planned = of or scene()
    return {
        "scene": {
            "scene_id": planned.scene_id,
            "clips": [
                {
                    "camera": clip.camera,
                    "images": [base64.b64encode(image).decode() for image in clip.images],
                }
                for clip in planned.clips
            ],
            "history": planned.history.tolist(),
            "route": None if planned.route is None else planned.route.tolist(),
        },
        "controls": {"n": 2, "seed": 1} | controls,
    }
