"""The same request gives the same bytes over HTTP, however it is asked."""

from __future__ import annotations

from model.bundled import CHECKPOINT, SCENES
from model.driving.scene_store import read_scenes
from model.engines.torch.engine import TorchEngine
from service.settings import Settings
from tests.end_to_end.same_bytes import WAYS, compare
from tests.service.serving import serve


def test_the_same_request_gives_the_same_bytes() -> None:
    scene = next(read_scenes(SCENES, dense=False)).scene
    with serve(TorchEngine(CHECKPOINT), Settings()) as served:
        assert compare(served.http, scene) == dict.fromkeys(WAYS, 0)
