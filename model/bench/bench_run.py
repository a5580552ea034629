"""The bench: workloads over contenders in shuffled order, repeated; medians with their spread."""

from __future__ import annotations

import json
import os
import random
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from looktwice.model.bench.quiet import wait_until_quiet
from looktwice.model.bench.workload import Workload

_SHARES: Final = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0)
"""Loads among which the knee is looked for, in requests during the latency of a scene alone."""
_BEHIND: Final = 3
"""Latencies of a scene alone: where the last of many answers comes so long after the last request, or later,
a load is not kept up with."""


@dataclass(frozen=True)
class BenchJob:
    """What is compared.

    Attributes:
        contenders: names; ``torch`` may carry shortcuts, see `looktwice.model.bench.child`.
        workloads: each is asked of each contender that can do it.
        checkpoint, scenes: the same for all.
        repeats: measured rounds, after one that is not.
        device: ``cpu`` or ``cuda``.
        vllm_python: the interpreter that has vLLM.
    """

    contenders: tuple[str, ...]
    workloads: tuple[Workload, ...]
    checkpoint: Path
    scenes: Path
    repeats: int = 5
    device: str = "cpu"
    vllm_python: str = sys.executable


@dataclass(frozen=True)
class BenchRow:
    """Figures of one contender at one workload; a plan is a request with all its draws.

    ``latency_p50_s_spread`` and ``plans_per_s_spread`` are the least and the most of a round; ``valid_share``
    counts draws that parse, ``forced_share`` tokens that the format left no choice about. ``peak_bytes`` are
    of the contender's process and its children at this work, with all that they keep between turns.
    """

    engine: str
    scenes: int
    n: int
    thinking: str
    temperature: float
    latency_p50_s: float
    latency_p50_s_spread: tuple[float, float]
    latency_p95_s: float
    plans_per_s: float
    plans_per_s_spread: tuple[float, float]
    tokens_per_s: float
    passes_per_response: float
    tokens_per_response: float
    valid_share: float
    forced_share: float
    peak_bytes: int
    counts: Mapping[str, float] = field(default_factory=dict)


def can_do(contender: str, workload: Workload) -> bool:
    """Without a grammar nothing decides the branch, or whether there is a picture, but the model."""
    free = workload.thinking == "adaptive" and workload.camera is None
    return free or not (contender == "vllm" or contender.startswith("transformers"))


def run(job: BenchJob, tell: Callable[[str], None]) -> list[BenchRow]:
    """Run a job; ``tell`` hears what is being done.

    Raises:
        RuntimeError: a contender's process ended early.
    """
    pairs = [(name, load) for load in job.workloads for name in job.contenders if can_do(name, load)]
    replies: dict[tuple[str, Workload], list[dict[str, Any]]] = {pair: [] for pair in pairs}
    order = random.Random(0)
    with ExitStack() as stack:
        processes: dict[str, _Process] = {}
        for names in _together(job.contenders):
            tell(f"starting {', '.join(names)}")
            process = stack.enter_context(_process(job, names))
            processes |= dict.fromkeys(names, process)
        for repeat in range(job.repeats + 1):
            order.shuffle(pairs)
            for name, load in pairs:
                tell(f"round {repeat} of {job.repeats}: {name}, {load.scenes} x {load.n}, {load.thinking}")
                number = repeat * len(job.workloads) + job.workloads.index(load)
                wait_until_quiet()
                reply = processes[name].ask(name, load, number)
                if repeat:
                    replies[name, load].append(reply)
    return [
        _row(name, load, replies[name, load])
        for load in job.workloads
        for name in job.contenders
        if (name, load) in replies
    ]


@dataclass(frozen=True)
class PlannerLatency:
    """Latency of a planner's first request for a scene, and of the next ones: same pictures, moved on."""

    n: int
    cold_p50_s: float
    next_p50_s: float

    @property
    def ratio(self) -> float:
        """Of the next to the first."""
        return self.next_p50_s / self.cold_p50_s


def run_planner(job: BenchJob, load: Workload, steps: int = 4) -> PlannerLatency:
    """Ask the torch engine as a 10 Hz planner does, whose pictures change twice a second."""
    cold: list[float] = []
    next_: list[float] = []
    with _process(job, ["torch"]) as process:
        for number in range(4 * job.repeats):
            for step in range(steps + 1):
                [answer] = process.ask("torch", load, number, step=step)["answers"]
                if number >= job.repeats:  # those before warm it up
                    (next_ if step else cold).append(answer["latency_s"])
    return PlannerLatency(load.n, statistics.median(cold), statistics.median(next_))


@dataclass(frozen=True)
class Deadlines:
    """Requests that arrive by chance at ``per_s`` on average, each with a deadline.

    ``honoured`` is the share that was answered in time with all its draws.
    """

    requests: int
    n: int
    per_s: float
    deadline_ms: int
    honoured: float
    latency_p50_s: float
    latency_p99_s: float


def run_deadlines(job: BenchJob, alone: Workload, deadline_ms: int, requests: int = 500) -> Deadlines:
    """Ask the torch engine by a Poisson process, at the knee of its load curve.

    ``alone`` is what each request asks for.

    The knee is the largest load that is kept up with, at a median latency of at most twice that of a scene
    alone; found by a hundred such requests at each of a few loads. Where none is, it is the smallest.
    """
    load = replace(alone, scenes=requests, deadline_ms=deadline_ms)
    tried, n = replace(load, scenes=100), load.n
    with _process(job, ["torch"]) as process:
        for number in range(3):
            process.ask("torch", replace(alone, scenes=16), number)
        alone_s = _median([process.ask("torch", alone, 3 + k) for k in range(20)])
        per_s = _SHARES[0] / alone_s
        for number, share in enumerate(_SHARES, start=23):
            arrivals_s = _arrivals(share / alone_s, tried.scenes)
            reply = process.ask("torch", tried, number, arrivals_s=arrivals_s)
            behind_s = reply["wall_s"] - arrivals_s[-1]
            if _median([reply]) > 2 * alone_s or behind_s > _BEHIND * alone_s:
                break
            per_s = share / alone_s
        answers = process.ask("torch", load, 31, arrivals_s=_arrivals(per_s, requests))["answers"]
    latencies = [answer["latency_s"] for answer in answers]
    in_time = [
        answer["latency_s"] * 1000 <= deadline_ms
        and len(answer["responses"]) == n
        and all(response["valid"] for response in answer["responses"])
        for answer in answers
    ]
    p50, p99 = (float(np.percentile(latencies, share)) for share in (50, 99))
    return Deadlines(requests, n, per_s, deadline_ms, statistics.mean(in_time), p50, p99)


def _arrivals(per_s: float, count: int) -> list[float]:
    arrivals_s: list[float] = np.random.default_rng(0).exponential(1 / per_s, count).cumsum().tolist()
    return arrivals_s


def _median(replies: Sequence[Mapping[str, Any]]) -> float:
    latencies: list[float] = [answer["latency_s"] for reply in replies for answer in reply["answers"]]
    return statistics.median(latencies)


def _together(names: Sequence[str]) -> list[list[str]]:
    """Names that share a process."""
    shared = [name for name in names if name.startswith("vllm")]
    return [[name] for name in names if name not in shared] + ([shared] if shared else [])


class _Process:
    def __init__(self, name: str, process: subprocess.Popen[str], replies: Any) -> None:
        self._name, self._process, self._replies = name, process, replies

    def read(self) -> dict[str, Any]:
        line = self._replies.readline()
        if not line:
            raise RuntimeError(f"the process of {self._name} ended early, with {self._process.wait()}")
        reply: dict[str, Any] = json.loads(line)
        return reply

    def ask(
        self, contender: str, load: Workload, number: int, *, step: int = 0, arrivals_s: Sequence[float] = ()
    ) -> dict[str, Any]:
        question = {
            "contender": contender,
            "workload": asdict(load),
            "number": number,
            "step": step,
            "arrivals_s": list(arrivals_s),
        }
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(question) + "\n")
        self._process.stdin.flush()
        return self.read()


@contextmanager
def _process(job: BenchJob, names: Sequence[str]) -> Iterator[_Process]:
    python = job.vllm_python if names[0].startswith("vllm") else sys.executable
    settings = {
        "contenders": list(names),
        "checkpoint": str(job.checkpoint),
        "scenes": str(job.scenes),
        "device": job.device,
    }
    reading, writing = os.pipe()
    log_path = os.environ.get("LOOKTWICE_BENCH_LOG", os.devnull)
    with open(log_path, "a", encoding="utf-8") as log, os.fdopen(reading, encoding="utf-8") as replies:
        process = subprocess.Popen(
            [python, "-m", "looktwice.model.bench.child", str(writing), json.dumps(settings)],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            pass_fds=(writing,),
            text=True,
        )
        os.close(writing)
        try:
            made = _Process(", ".join(names), process, replies)
            made.read()
            yield made
        finally:
            assert process.stdin is not None
            process.stdin.close()
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _row(name: str, load: Workload, replies: Sequence[Mapping[str, Any]]) -> BenchRow:
    answers = [answer for reply in replies for answer in reply["answers"]]
    latencies = [answer["latency_s"] for answer in answers]
    responses = [response for answer in answers for response in answer["responses"]]
    medians = [_median([reply]) for reply in replies]
    rates = [load.scenes / reply["wall_s"] for reply in replies]
    plans, tokens = len(answers), sum(each["tokens"] for each in responses)
    keys = replies[0]["counts"]
    return BenchRow(
        engine=name,
        scenes=load.scenes,
        n=load.n,
        thinking=load.thinking,
        temperature=load.temperature,
        latency_p50_s=float(np.percentile(latencies, 50)),
        latency_p50_s_spread=(min(medians), max(medians)),
        latency_p95_s=float(np.percentile(latencies, 95)),
        plans_per_s=statistics.median(rates),
        plans_per_s_spread=(min(rates), max(rates)),
        tokens_per_s=tokens / sum(reply["wall_s"] for reply in replies),
        passes_per_response=statistics.mean(each["passes"] for each in responses),
        tokens_per_response=statistics.mean(each["tokens"] for each in responses),
        valid_share=statistics.mean(each["valid"] for each in responses),
        forced_share=1 - sum(each["chosen"] for each in responses) / tokens,
        peak_bytes=max(reply["peak_bytes"] for reply in replies),
        counts={key: sum(reply["counts"][key] for reply in replies) / plans for key in keys},
    )
