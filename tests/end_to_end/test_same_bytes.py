"""The same request gives the same bytes over HTTP, however it is asked."""

from __future__ import annotations

import base64

from looktwice.model.bundled import CHECKPOINT, SCENES
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.engines.torch.engine import TorchEngine
from looktwice.service.operations.settings import Settings
from tests.end_to_end.same_bytes import WAYS, compare, draws_of, told_last
from tests.service.scripted_engine import KEEP_ON
from tests.service.serving import body, serve


def test_the_same_request_gives_the_same_bytes() -> None:
    scene = next(read_scenes(SCENES, dense=False)).scene
    with serve(TorchEngine(CHECKPOINT), Settings()) as served:
        assert compare(served.http, scene) == dict.fromkeys(WAYS, 0)


def test_so_do_reflections_and_chats() -> None:
    scene = next(read_scenes(SCENES, dense=False)).scene
    plan = body(scene, n=3)
    reflect = body(scene, n=3, logprobs=True) | {"plan": str(KEEP_ON)}
    images = [image for clip in scene.clips for image in clip.images]
    urls = ["data:image/jpeg;base64," + base64.b64encode(image).decode() for image in images]
    content = [{"type": "image_url", "image_url": {"url": url}} for url in urls]
    extras = {"history": plan["scene"]["history"], "route": plan["scene"]["route"]}
    chat = {"messages": [{"role": "user", "content": content}], "n": 3, "seed": 1, "looktwice": extras}
    with serve(TorchEngine(CHECKPOINT), Settings()) as served:
        fresh, again = (served.http.post("/v1/reflect", json=reflect).json() for _ in range(2))
        streamed = told_last(served.http.post("/v1/reflect", json=reflect | {"stream": True}))
        planned = served.http.post("/v1/plan", json=plan).json()
        chats = [served.http.post("/v1/chat/completions", json=chat).json()["choices"] for _ in range(2)]
    assert draws_of(fresh) == draws_of(again) == draws_of(streamed)
    assert chats[0] == chats[1]
    told = [choice["message"]["looktwice"] for choice in chats[0]]
    for draw in told:
        assert draw.pop("assumed") == []
    assert draws_of({"draws": told}) == draws_of(planned)
