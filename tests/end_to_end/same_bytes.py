"""The same plan request, asked over HTTP in several ways: how many draws differ in a byte.

Run by hand over more scenes: ``python -m tests.end_to_end.same_bytes SCENES COUNT [FIRST]``, in pieces.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any

import httpx

from looktwice.model.bundled import CHECKPOINT
from looktwice.model.driving.scene import Scene
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.engines.torch.engine import TorchEngine
from looktwice.service.operations.settings import Settings
from tests.service.serving import body, serve

DRAWS, FEW = 6, 3
WAYS = ("repeated", "streamed", "batched", f"n = {FEW} of {DRAWS}", "under load")


def draws_of(answer: dict[str, Any]) -> list[str]:
    """Each draw's JSON, as it was sent but for blanks, without what tells of time."""
    return [json.dumps(draw, sort_keys=True) for draw in answer["draws"]]


def told_last(stream: httpx.Response) -> dict[str, Any]:
    """The data of the event that ends a stream."""
    told: dict[str, Any] = json.loads(stream.text.strip().split("\n\n")[-1].split("data: ", 1)[1])
    return told


def asked(scene: Scene, n: int) -> dict[str, Any]:
    """A request whose answer tells all that is worked out, log-probabilities too."""
    return body(scene, n=n, seed=1, logprobs=True)


def compare(http: httpx.Client, scene: Scene) -> Counter[str]:
    """How many draws of a scene differ from the fresh ones, by how they were asked for."""

    def ask(n: int = DRAWS, **more: Any) -> httpx.Response:
        answer = http.post("/v1/plan", json=asked(scene, n) | more)
        assert answer.status_code == 200, answer.text
        return answer

    fresh = draws_of(ask().json())
    batch = {"requests": [body(scene, n=FEW, seed=9), asked(scene, DRAWS)]}
    batched = http.post("/v1/plan/batch", json=batch).json()["results"][1]["response"]
    found = {
        "repeated": draws_of(ask().json()),
        "streamed": draws_of(told_last(ask(stream=True))),
        "batched": draws_of(batched),
        f"n = {FEW} of {DRAWS}": draws_of(ask(n=FEW).json()),
    }
    with ThreadPoolExecutor(3) as pool:
        others = [pool.submit(http.post, "/v1/plan", json=body(scene, n=4, seed=seed)) for seed in (2, 3)]
        found["under load"] = draws_of(pool.submit(ask).result().json())
        assert all(other.result().status_code == 200 for other in others)
    assert all(len(draws) == (FEW if way.startswith("n =") else DRAWS) for way, draws in found.items())
    return Counter({way: sum(a != b for a, b in zip(fresh, found[way], strict=False)) for way in WAYS})


def main() -> None:
    path, count, first = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else 0
    differing = Counter(dict.fromkeys(WAYS, 0))
    with serve(TorchEngine(CHECKPOINT), Settings()) as served:
        for done, labelled in enumerate(islice(read_scenes(path, dense=False), first, first + count), 1):
            differing.update(compare(served.http, labelled.scene))
            if done in (1, count) or done % 10 == 0:
                print(f"draws of {done} scenes that differ: {dict(differing)}", flush=True)


if __name__ == "__main__":
    main()
