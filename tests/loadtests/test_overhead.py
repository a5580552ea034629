from __future__ import annotations

import httpx
import pytest

from looktwice.loadtests.overhead import NoAnswer, measure
from looktwice.model.bundled import SCENES
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.engines.engine import EngineError
from looktwice.service.operations.settings import Settings
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import serve

BUNDLED = tuple(read_scenes(SCENES, dense=False))


def test_every_kind_of_body_is_measured() -> None:
    engine = ScriptedEngine()
    with serve(engine, Settings()) as served:
        rows = list(measure(served.http, BUNDLED, n=2, requests=4))
    assert [row.payload for row in rows] == ["json", "msgpack", "multipart"]
    # A picture that was sent before would be remembered.
    assert len({asked.scene.clips[0].images for asked in engine.submitted}) == 3 * (4 + 3)
    sizes = {row.payload: row.body_bytes for row in rows}
    assert sizes["msgpack"] < 0.85 * sizes["json"]
    for row in rows:
        assert row.overhead_ms > row.before_ms > 0
        assert row.share == row.overhead_ms / row.engine_ms


def test_what_is_no_plan_is_not_measured() -> None:
    engine = ScriptedEngine()
    engine.failure = EngineError("broke")
    with serve(engine, Settings()) as served, pytest.raises(NoAnswer, match="503"):
        list(measure(served.http, BUNDLED, n=2, requests=1))
    with httpx.Client(base_url="http://127.0.0.1:9") as nobody, pytest.raises(httpx.ConnectError):
        list(measure(nobody, BUNDLED, n=2, requests=1))
