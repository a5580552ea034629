"""Readiness tells when nobody was answered, and when pictures wait."""

from __future__ import annotations

import time

from model.engines.engine import Load
from service.settings import Settings
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import serve
from tests.service.test_errors import problem


class WaitingEngine(ScriptedEngine):
    """Whose pictures have waited for so long."""

    pictures_wait_s = 0.0

    @property
    def load(self) -> Load:
        return Load(rows=64, rows_used=0, pictures_wait_s=self.pictures_wait_s)


def test_a_loop_that_stood_still_is_not_ready_for_a_while(engine: ScriptedEngine) -> None:
    with serve(engine, Settings(stall_s=0.5)) as served:
        served.in_loop(lambda: time.sleep(1.0))
        served.until(lambda: served.http.get("/readyz").status_code == 503)
        assert "nobody was answered" in problem(served.http.get("/readyz"), "not-ready").detail
        assert served.http.get("/healthz").status_code == 200
        served.until_ready()


def test_pictures_that_wait_make_it_not_ready() -> None:
    engine = WaitingEngine()
    with serve(engine, Settings(stall_s=30.0)) as served:
        engine.pictures_wait_s = 31.0
        assert "pictures have waited" in problem(served.http.get("/readyz"), "not-ready").detail
        engine.pictures_wait_s = 0.0
        assert served.http.get("/readyz").status_code == 200
