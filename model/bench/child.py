"""A contender's process: reads one workload a line, answers it, writes one line of figures.

Each contender has a process of its own, so that their threads do not get into each other's way and peak
memory can be told. Figures go to a file descriptor of their own: libraries write to standard output.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from looktwice.model.bench.contenders import (
    SHORTCUTS,
    Contender,
    EngineContender,
    PlainVllm,
    TimedAnswer,
    Transformers,
)
from looktwice.model.bench.process_memory import forget_peaks, peak_bytes
from looktwice.model.bench.workload import Workload
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.engines.engine import PlanRequest
from looktwice.model.network.precision import fast_dtype

_ROWS = 96
_MAX_TOKENS = 600
"""More than the longest response that a trained model writes."""


def contenders(names: list[str], checkpoint: Path, device: str) -> dict[str, Contender]:
    """The contenders of one process; those with ``vllm`` in their name share one engine.

    All work in what the device multiplies fast, as ours does by itself.
    """
    made: dict[str, Contender] = {}
    dtype = fast_dtype(device)
    for name in names:
        if name.startswith("vllm"):
            from looktwice.model.engines.vllm.engine import VllmEngine, VllmSettings

            if "vllm-grammar" not in made:
                engine = VllmEngine(
                    checkpoint,
                    VllmSettings(
                        _ROWS, str(dtype).removeprefix("torch."), {"enforce_eager": device == "cpu"}
                    ),
                )
                made["vllm-grammar"] = EngineContender(engine)
                made["vllm"] = PlainVllm(checkpoint, engine, _MAX_TOKENS)
        elif name.startswith("transformers"):
            made[name] = Transformers(
                checkpoint,
                dtype=dtype,
                device=device,
                max_tokens=_MAX_TOKENS,
                cache="static" if name == "transformers-static" else "dynamic",
            )
        else:
            made[name] = EngineContender(_torch_engine(name, checkpoint, device))
    return made


def _torch_engine(name: str, checkpoint: Path, device: str) -> Any:
    """``torch``, or ``torch+…`` with some shortcuts only: ``torch+none``, ``torch+jump,shared_prompts``."""
    from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
    from looktwice.model.engines.torch.shortcuts import Shortcuts

    settings = TorchSettings.on(device, _ROWS)
    if "+" in name:
        wanted = name.partition("+")[2].split(",")
        settings = replace(settings, shortcuts=Shortcuts(**{each: each in wanted for each in SHORTCUTS}))
    return TorchEngine(checkpoint, settings)


async def _serve(job: Mapping[str, Any], replies: Any) -> None:
    made = contenders(job["contenders"], Path(job["checkpoint"]), job["device"])
    scenes = [labelled.scene for labelled in read_scenes(Path(job["scenes"]), dense=False)]
    for contender in made.values():
        await contender.start()
    print(json.dumps({"ready": sorted(made)}), file=replies, flush=True)
    # Reading blocks the loop, which has nothing to do meanwhile.
    for line in sys.stdin:
        asked = json.loads(line)
        contender = made[asked["contender"]]
        requests = Workload(**asked["workload"]).requests(scenes, asked["number"], asked["step"])
        forget_peaks()
        before, began_s = contender.counts(), time.perf_counter()
        answers = await _answers(contender, requests, asked["arrivals_s"])
        wall_s = time.perf_counter() - began_s
        counts = {name: count - before[name] for name, count in contender.counts().items()}
        reply = {
            "wall_s": wall_s,
            "answers": [asdict(answer) for answer in answers],
            "counts": counts,
            "peak_bytes": peak_bytes(),
        }
        print(json.dumps(reply), file=replies, flush=True)
    for contender in made.values():
        await contender.stop()


async def _answers(
    contender: Contender, requests: Sequence[PlanRequest], arrivals_s: Sequence[float]
) -> list[TimedAnswer]:
    """The answers to requests that arrive at once, or each so many seconds from now."""
    if not arrivals_s:
        return await contender.answer(requests)

    async def later(request: PlanRequest, arrival_s: float) -> TimedAnswer:
        await asyncio.sleep(arrival_s)
        [answer] = await contender.answer([request])
        return answer

    return list(await asyncio.gather(*map(later, requests, arrivals_s)))


if __name__ == "__main__":
    with os.fdopen(int(sys.argv[1]), "w", encoding="utf-8") as replies:
        asyncio.run(_serve(json.loads(sys.argv[2]), replies))
