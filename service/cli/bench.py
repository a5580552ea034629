"""`looktwice bench`: speed, as ratios within one run."""

from __future__ import annotations

import json
import secrets
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from looktwice.service.cli.engines import Device
from looktwice.service.cli.options import (
    DEFAULT_CHECKPOINT,
    DEFAULT_SCENES,
    Checkpoint,
    Json,
    ScenePath,
    reported_errors,
)

if TYPE_CHECKING:
    import httpx

    from looktwice.model.bench.bench_report import Roofline
    from looktwice.model.bench.bench_run import BenchRow

bench = typer.Typer(help="Measure speed, as ratios within one run.", no_args_is_help=True)

_SEEDS = 2**20
_ENGINES = "torch,transformers,transformers-static,vllm,vllm-grammar"


@bench.command()
def engine(
    scenes: ScenePath = DEFAULT_SCENES,
    checkpoint: Checkpoint = DEFAULT_CHECKPOINT,
    engines: Annotated[str, typer.Option(help="Which, by commas.")] = _ENGINES,
    at_once: Annotated[str, typer.Option(help="Scenes at once, by commas.")] = "1,4,16",
    draws: Annotated[str, typer.Option(help="Draws a scene, by commas.")] = "1,6",
    thinking: Annotated[
        str | None, typer.Option(help="Modes, by commas; without it all that the format has.")
    ] = None,
    format: Annotated[
        str | None, typer.Option(help="Of the responses; the checkpoint's first without it.")
    ] = None,
    camera: Annotated[
        str | None, typer.Option(help="Whose picture each response imagines, in a format that imagines.")
    ] = None,
    temperature: Annotated[float, typer.Option(help="Of all draws.", min=0.0, max=2.0)] = 1.0,
    repeats: Annotated[int, typer.Option(help="Measured rounds.", min=1)] = 5,
    shortcuts: Annotated[bool, typer.Option(help="Also our shortcuts, one after the other.")] = True,
    deadline_ms: Annotated[
        int, typer.Option(help="Of 500 requests at the knee of our load curve; 0 leaves them out.", min=0)
    ] = 1000,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    vllm_python: Annotated[
        Path, typer.Option(help="The interpreter that has vLLM; `make vllm` makes this one.")
    ] = Path(".venv-vllm/bin/python"),
    preset: Annotated[str, typer.Option(help="A published size instead of a checkpoint: cf-vla-3b.")] = "",
    random_weights: Annotated[bool, typer.Option(help="Said with a preset: its weights are random.")] = False,
    as_json: Json = False,
) -> None:
    """Our engine, transformers and vLLM on the same checkpoint, scenes and controls."""
    with reported_errors(), tempfile.TemporaryDirectory() as folder:
        from looktwice.model.bench.bench_report import BenchReport
        from looktwice.model.bench.bench_run import BenchJob, run, run_deadlines, run_planner
        from looktwice.model.bench.workload import Workload
        from looktwice.model.families.registry import family_named
        from looktwice.model.network.checkpoint import read_parts

        if preset:
            checkpoint = _random_checkpoint(preset, checkpoint, Path(folder), device, random_weights)
        written = format or read_parts(checkpoint).card.formats[0]
        family = family_named(written)
        if camera is not None and family.imagination is None:
            raise ValueError(f"responses in format {written} imagine no pictures: leave --camera out")
        modes: list[Any] = list(family.thinking_choices)
        if thinking is not None:
            modes = thinking.split(",")
        loads = tuple(
            Workload(_whole(count), _whole(n), mode, written, temperature, camera=camera)
            for count in at_once.split(",")
            for n in draws.split(",")
            for mode in modes
        )
        for load in loads:
            # Refused before the work begins.
            load.controls()
            if refused := family.thinking_refused(load.thinking):
                raise ValueError(f"--thinking: {refused}")
        names = tuple(engines.split(","))
        if unknown := set(names) - set(_ENGINES.split(",")):
            raise ValueError(f"unknown engine {', '.join(sorted(unknown))}; known are {_ENGINES}")
        # Not resolved: an environment's interpreter is a link, and found by where it lies.
        python = str(vllm_python.absolute()) if vllm_python.exists() else sys.executable

        def tell(what: str) -> None:
            typer.echo(what, err=True)

        job = BenchJob(names, loads, checkpoint, scenes, repeats, device, python)
        rows = run(job, tell)
        steps: list[BenchRow] = []
        ladder = tuple(load for load in loads if load.n > 1 and load.thinking == "adaptive")
        if shortcuts and ladder and "torch" in names:
            entries = _ladder(device)
            # On a GPU one after the other: large models do not fit side by side.
            for together in [entries] if device == "cpu" else [(each,) for each in entries]:
                steps += run(BenchJob(together, ladder, checkpoint, scenes, repeats, device), tell)
        alone = [Workload(1, _whole(n), "adaptive", written, camera=camera) for n in draws.split(",")]
        planners = [run_planner(job, load) for load in alone if "torch" in names]
        rooflines = _rooflines(rows, checkpoint, written, device)
        deadlines = []
        if deadline_ms and "torch" in names:
            most = max(alone, key=lambda load: load.n)
            deadlines.append(run_deadlines(job, most, deadline_ms))
        report = BenchReport(tuple(rows), tuple(steps), tuple(rooflines), tuple(planners), tuple(deadlines))
        typer.echo(json.dumps(report.to_json()) if as_json else str(report))


@bench.command()
def precision(
    scenes: ScenePath = DEFAULT_SCENES,
    checkpoint: Checkpoint = DEFAULT_CHECKPOINT,
    n: Annotated[int, typer.Option(help="Draws a scene.", min=1, max=64)] = 6,
    as_json: Json = False,
) -> None:
    """How often rounding in float32 and bfloat16 changes a response, and how close the decision was."""
    with reported_errors():
        from looktwice.model.bench.rounding import measure
        from looktwice.model.driving.scene_store import read_scenes

        found = measure(checkpoint, [each.scene for each in read_scenes(scenes, dense=False)], n)
        if as_json:
            typer.echo(json.dumps([vars(each) for each in found]))
            return
        for each in found:
            largest = f", largest margin {max(each.margins):.1e}" if each.margins else ""
            typer.echo(f"{each.name}: {each.different} of {each.responses} responses differ{largest}")


@bench.command()
def score(
    navsim: Annotated[
        list[Path] | None,
        typer.Option(help="Folder that holds the package navsim or nuplan; once for each. None: ours only."),
    ] = None,
    navsim_python: Annotated[
        Path | None, typer.Option(help="Interpreter that has what NAVSIM needs; this one without it.")
    ] = None,
    repeats: Annotated[int, typer.Option(help="Measured rounds.", min=1)] = 5,
    service: Annotated[
        str | None, typer.Option(help="URL of a running service, asked for the same 6 plans. None: no HTTP.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Our scorer of plans, and NAVSIM's own beside it, in seconds of one core; and scores over HTTP."""
    with reported_errors():
        from looktwice.loadtests.score_trips import score_ms, score_request
        from looktwice.model.bench.scoring_speed import FEW, measure, scene

        http_ms = None
        if service is not None:
            with _client_of(service) as client:
                http_ms = score_ms(client, score_request(*scene(FEW)), 20 * repeats)
        found = measure(repeats, navsim or [], navsim_python and navsim_python.absolute())
        if as_json:
            typer.echo(json.dumps(found.to_json() | {"http_6_ms": http_ms}))
            return
        typer.echo(f"6 plans {1000 * found.seconds_6:.1f} ms, 4,096 plans {found.seconds_4096:.2f} s")
        if http_ms is not None:
            typer.echo(f"6 plans over HTTP {http_ms:.1f} ms")
        if found.navsim_seconds_a_plan is not None:
            theirs_ms = 1000 * found.navsim_seconds_a_plan
            typer.echo(f"NAVSIM {theirs_ms:.1f} ms a plan, {found.times_navsim:.0f} times ours")


@bench.command()
def egodriver(
    scenes: ScenePath = DEFAULT_SCENES,
    checkpoint: Checkpoint = DEFAULT_CHECKPOINT,
    sessions: Annotated[int, typer.Option(help="Rollouts at once.", min=1)] = 8,
    steps: Annotated[int, typer.Option(help="Drives of each.", min=1)] = 6,
    rounds: Annotated[int, typer.Option(help="Measured rounds.", min=1)] = 5,
    n: Annotated[int, typer.Option(help="Draws a drive.", min=1, max=64)] = 6,
    thinking: Annotated[
        Literal["adaptive", "always", "never"], typer.Option(help="Who decides on a second look.")
    ] = "adaptive",
    device: Device = "cpu",
    as_json: Json = False,
) -> None:
    """The egodriver: the same rollouts one by one and together, without deadlines."""
    with reported_errors():
        from itertools import islice

        from looktwice.clients.alpasim.throughput import measure
        from looktwice.model.driving.scene_store import read_scenes

        shown = [each.scene for each in islice(read_scenes(scenes, dense=False), sessions)]
        options = f"--n {n} --thinking {thinking} --device {device} --max-sessions {2 * sessions}".split()
        with _egodriver("--checkpoint", str(checkpoint), *options) as address:
            found = measure(address, shown, sessions=sessions, steps=steps, rounds=rounds)
        if as_json:
            typer.echo(json.dumps({"n": n, "thinking": thinking, "device": device} | found.to_json()))
            return
        figures = found.to_json()
        typer.echo(
            f"{sessions} rollouts, drives/s: {figures['one_by_one_drives_per_s']:.2f} one by one, "
            f"{figures['together_drives_per_s']:.2f} together: {found.ratio:.2f} times as many"
        )


@bench.command()
def http(
    service: Annotated[str, typer.Option(help="URL of a running service.")] = "http://127.0.0.1:8000",
    scenes: ScenePath = DEFAULT_SCENES,
    n: Annotated[int, typer.Option(help="Draws.", min=1, max=64)] = 6,
    requests: Annotated[int, typer.Option(help="Of each kind of body.", min=1)] = 30,
    seed: Annotated[
        int | None,
        typer.Option(help="Of pictures and draws; another one each time if not given.", min=0),
    ] = None,
    as_json: Json = False,
) -> None:
    """What HTTP adds to planning, by kind of body, on a service that is otherwise idle."""
    with reported_errors():
        from looktwice.loadtests.overhead import measure
        from looktwice.model.driving.scene_store import read_scenes

        labelled = tuple(read_scenes(scenes, dense=False))
        # The service may remember the pictures of an earlier run.
        chosen = secrets.randbelow(_SEEDS) if seed is None else seed
        with _client_of(service) as client:
            rows = list(measure(client, labelled, n=n, requests=requests, seed=chosen))
    if as_json:
        typer.echo(json.dumps({"n": n, "rows": [vars(row) | {"share": row.share} for row in rows]}))
        return
    for row in rows:
        typer.echo(
            f"{row.payload:9} {row.body_bytes / 1000:6.1f} kB   engine {row.engine_ms:7.1f} ms   "
            f"HTTP {row.overhead_ms:5.1f} ms ({row.share:.1%}), {row.before_ms:.1f} ms of it in the service"
        )


@contextmanager
def _client_of(service: str) -> Iterator[httpx.Client]:
    """A client with the key of the environment; raises `RuntimeError` where the service is not there."""
    import httpx

    from looktwice.clients.calling import Access, headers_of

    headers = headers_of(Access.from_environment())
    try:
        with httpx.Client(base_url=service, timeout=120, headers=headers) as client:
            yield client
    except httpx.HTTPError as error:
        raise RuntimeError(f"no service answers at {service}: {error}") from error


@contextmanager
def _egodriver(*options: str) -> Iterator[str]:
    """An egodriver in a process of its own; where it listens."""
    import grpc

    with tempfile.TemporaryDirectory() as folder, (Path(folder) / "log").open("w+") as log:
        address = f"unix://{folder}/driver.sock"
        command = [
            sys.executable,
            "-m",
            "looktwice.service.cli",
            "egodriver",
            "--host",
            address,
            "--deadline-ms",
            "0",
        ]
        process = subprocess.Popen([*command, *options], stderr=log)
        try:
            with grpc.insecure_channel(address) as channel:
                ready = grpc.channel_ready_future(channel)
                while not ready.done():
                    if process.poll() is not None:
                        log.seek(0)
                        raise RuntimeError(f"the egodriver ended: {log.read()[-2000:]}")
                    with suppress(grpc.FutureTimeoutError):
                        ready.result(timeout=0.2)
            yield address
        finally:
            process.kill()
            process.wait()


def _whole(text: str) -> int:
    if not text.isdecimal() or not int(text):
        raise ValueError(f"{text!r} is no positive number")
    return int(text)


def _ladder(device: str) -> tuple[str, ...]:
    """The torch engine without shortcuts, then with one more at a time of those that the device knows."""
    from looktwice.model.bench.contenders import SHORTCUTS

    known = [each for each in SHORTCUTS if device != "cpu" or each != "capture"]
    return "torch+none", *(f"torch+{','.join(known[:count])}" for count in range(1, len(known) + 1))


def _random_checkpoint(preset: str, words_of: Path, folder: Path, device: str, agreed: bool) -> Path:
    from looktwice.model.bench.presets import PRESETS, write_random

    if preset not in PRESETS:
        raise ValueError(f"unknown preset {preset!r}; known are {', '.join(PRESETS)}")
    if not agreed:
        raise ValueError("a preset has no trained weights: say --random-weights")
    write_random(PRESETS[preset], words_of, folder / preset, device=device)
    return folder / preset


def _rooflines(rows: list[BenchRow], checkpoint: Path, format: str, device: str) -> list[Roofline]:
    from looktwice.model.bench.bench_report import Roofline
    from looktwice.model.bench.roofline import measure, work_of_plan
    from looktwice.model.network.checkpoint import read_config, read_parts
    from looktwice.model.network.precision import fast_dtype

    dtype = fast_dtype(device)
    machine, parts, config = measure(device, dtype), read_parts(checkpoint), read_config(checkpoint)
    prompt = parts.inputs.longest_prompt(format)
    slices, grid_rows, columns = parts.settings.grid
    patches = len(parts.settings.cameras) * slices * grid_rows * columns
    found = []
    for row in rows:
        if row.engine != "torch" or row.thinking != "adaptive":
            continue
        work = work_of_plan(
            config,
            prompt,
            patches,
            tokens=row.counts["kept"],
            passes=row.counts["passes"],
            scene_passes=row.counts["scene_passes"],
            together=row.scenes,
            dtype=dtype,
        )
        least_s, measured_s = work.seconds(machine), 1 / row.plans_per_s
        found.append(Roofline(machine, row.scenes, row.n, work, least_s, measured_s))
    return found
