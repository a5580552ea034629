"""`looktwice plan`: plan for scenes or requests on this machine, print the plans and draw a picture."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from looktwice.service.cli.engines import EngineName, make_engine
from looktwice.service.cli.options import (
    DEFAULT_CHECKPOINT,
    DEFAULT_SCENES,
    Checkpoint,
    Json,
    reported_errors,
)

if TYPE_CHECKING:
    import looktwice.clients.wire as wire
    from looktwice.model.driving.scene import LabelledScene
    from looktwice.model.engines.engine import Draw, Engine, PlanRequest
    from looktwice.model.network.model_card import ModelCard

_BESIDE_REQUESTS: Final = ("scenes", "checkpoint", "engine", "limit", "skip", "out", "as_json")
"""What a request does not say itself."""
_ROWS: Final = 96
"""Draws decoded at once."""


def plan(
    context: typer.Context,
    scenes: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Scene files, or requests for /v1/plan as .json; the bundled scenes without any. "
            "A request is planned for as the service would, by its own controls, format and attempt; "
            "beside one, only --checkpoint, --engine, --out, --limit, --skip and --json are taken."
        ),
    ] = None,
    checkpoint: Checkpoint = DEFAULT_CHECKPOINT,
    engine: EngineName = "torch",
    limit: Annotated[int, typer.Option(help="Scenes to plan for, of each file.", min=1)] = 1,
    skip: Annotated[int, typer.Option(help="Scenes to pass over first.", min=0)] = 0,
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("out"),
    format: Annotated[
        str | None,
        typer.Option(help="Response format; the checkpoint's first without it. Foreign ones have none."),
    ] = None,
    thinking: Annotated[str, typer.Option(help="adaptive, always or never.")] = "adaptive",
    n: Annotated[int, typer.Option(help="Draws per scene.", min=1)] = 6,
    temperature: Annotated[float, typer.Option(help="0 takes the likeliest words.")] = 1.0,
    seed: Annotated[int, typer.Option(help="The same seed gives the same draws.")] = 0,
    route: Annotated[bool, typer.Option(help="Give the route to the model where there is one.")] = True,
    tracks: Annotated[
        bool,
        typer.Option(help="Give the tracks of the objects around, as a perfect tracker would tell them."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Plan for scenes and draw what was planned."""
    with reported_errors():
        files = scenes or [DEFAULT_SCENES]
        _refuse_what_requests_say(context, files)
        found = [each for file in files for each in islice(_read(file), skip, skip + limit)]
        if not found:
            raise ValueError("there are no scenes to plan for")
        asyncio.run(
            _plan(
                found,
                _engine(found, checkpoint, engine, format),
                out,
                as_json,
                format,
                {"route": route, "tracks": tracks},
                {"thinking": thinking, "n": n, "temperature": temperature, "seed": seed},
            )
        )


def _refuse_what_requests_say(context: typer.Context, files: list[Path]) -> None:
    """Raise `ValueError` where a file is a request and an option that it says itself is given too."""
    sources = {name: context.get_parameter_source(name) for name in context.params}
    given = [
        f"--{name}"
        for name, source in sources.items()
        if name not in _BESIDE_REQUESTS and source is not None and source.name == "COMMANDLINE"
    ]
    if given and (requests := [file for file in files if file.suffix == ".json"]):
        raise ValueError(f"{requests[0]} says itself how it is planned for; leave out {', '.join(given)}")


def _read(file: Path) -> Iterator[LabelledScene | wire.PlanRequest]:
    """The scenes of a file, or its one request."""
    if file.suffix != ".json":
        from looktwice.model.driving.scene_store import read_scenes

        yield from read_scenes(file, dense=False)
        return
    import looktwice.clients.wire as wire
    from looktwice.service.http.problem_documents import validated
    from looktwice.service.problems import ProblemError

    try:
        yield validated(wire.PlanRequest, json.loads(file.read_bytes()))
    except (ProblemError, ValueError) as error:
        raise ValueError(f"{file} is no request for /v1/plan: {error}") from None


def _requested(
    found: LabelledScene | wire.PlanRequest,
    card: ModelCard,
    format: str | None,
    given: dict[str, bool],
    controls: dict[str, Any],
) -> PlanRequest:
    """The engine's request for a scene, or for a request as the service would make it."""
    from looktwice.model.driving.scene import LabelledScene
    from looktwice.model.engines.engine import Controls, PlanRequest
    from looktwice.service.planning.validation import engine_request
    from looktwice.service.problems import ProblemError

    if isinstance(found, LabelledScene):
        scene = found.given(**given)
        return PlanRequest(scene.scene_id, scene, format or card.default_format, Controls(**controls))
    try:
        return engine_request(found, card, found.scene.scene_id)
    except ProblemError as error:
        raise ValueError(f"{found.scene.scene_id} cannot be planned for: {error}") from None


def _engine(
    found: Sequence[LabelledScene | wire.PlanRequest],
    checkpoint: Path,
    name: EngineName,
    format: str | None,
) -> Engine:
    """The engine, not started yet; a foreign checkpoint writes the formats that are asked for."""
    from looktwice.model.driving.scene import LabelledScene
    from looktwice.model.network.card import is_foreign

    asked = (format if isinstance(each, LabelledScene) else each.format for each in found)
    formats = [each for each in dict.fromkeys(asked) if each is not None] if is_foreign(checkpoint) else None
    return make_engine(checkpoint, _ROWS, name=name, formats=formats)


async def _plan(
    found: list[LabelledScene | wire.PlanRequest],
    engine: Engine,
    out: Path,
    as_json: bool,
    format: str | None,
    given: dict[str, bool],
    controls: dict[str, Any],
) -> None:
    import numpy as np

    from looktwice.model.driving.scene import LabelledScene
    from looktwice.model.driving.trajectory import agreed
    from looktwice.model.engines.engine import DrawFinished
    from looktwice.model.evaluation.pictures import plan_picture

    await engine.start()
    try:
        for each in found:
            request = _requested(each, engine.card, format, given, controls)
            scene = request.scene
            draws = [event.draw async for event in engine.submit(request) if isinstance(event, DrawFinished)]
            draws.sort(key=lambda draw: draw.index)
            picture = out / f"{scene.scene_id}.png"
            picture.parent.mkdir(parents=True, exist_ok=True)
            chosen = agreed(np.stack([draw.trajectory for draw in draws]))
            plan_picture(each if isinstance(each, LabelledScene) else scene, draws, picture, shown=chosen)
            if as_json:
                typer.echo(json.dumps(_as_json(scene.scene_id, draws, chosen, picture)))
            else:
                typer.echo("\n".join(_told(scene.scene_id, draws, chosen)))
                typer.echo(f"\npicture {picture}")
    finally:
        await engine.stop()


def _told(scene_id: str, draws: list[Draw], chosen: int) -> list[str]:
    """Each draw in a line, and what the one to drive by says."""
    from looktwice.service.planning.section_text import section_text

    lines = [f"scene {scene_id}"]
    for draw in draws:
        x_m, y_m, *_ = draw.trajectory[-1]
        branch = "thinks" if draw.looked_twice else "acts  "
        share = "" if draw.think_probability is None else f", think probability {draw.think_probability:.3f}"
        mark = "*" if draw.index == chosen else " "
        end = f"in {draw.times_s[-1]:g} s at x {x_m:.1f} m, y {y_m:.1f} m"
        lines.append(f"{mark} draw {draw.index} {branch} {end}{share}")
    draw = draws[chosen]
    lines += ["", f"Draw {chosen} (*) lies nearest to the others: the one to drive by. It says:"]
    if draw.plan is not None:
        lines += ["", "Meta actions:", str(draw.plan).rstrip()]
    if draw.thinking is not None:
        lines += ["", f"{'Thoughts' if draw.branch is None else 'Second look'}: {draw.thinking}"]
    if draw.revised_plan is not None:
        lines += ["", "Revised meta actions:", str(draw.revised_plan).rstrip()]
    for name, values in draw.sections.items():
        if said := section_text(name, values):
            lines += ["", said]
    return lines


def _as_json(scene_id: str, draws: list[Any], chosen: int, picture: Path) -> dict[str, Any]:
    return {
        "scene_id": scene_id,
        "picture": str(picture),
        "agreed": chosen,
        "draws": [
            {
                "index": draw.index,
                "text": draw.text,
                "branch": draw.branch,
                "think_probability": draw.think_probability,
                "trajectory": draw.trajectory.tolist(),
                "times_s": list(draw.times_s),
                "sections": dict(draw.sections),
                "tokens": dict(draw.tokens),
            }
            for draw in draws
        ],
    }
