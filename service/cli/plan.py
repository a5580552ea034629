"""`looktwice plan`: plan for scenes on this machine, print the plans and draw a picture."""

from __future__ import annotations

import asyncio
import json
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import typer

from service.cli.options import DEFAULT_CHECKPOINT, DEFAULT_SCENES, Checkpoint, Json, told


def plan(
    scenes: Annotated[
        list[Path] | None, typer.Argument(help="Scene files; the bundled test scenes without any.")
    ] = None,
    checkpoint: Checkpoint = DEFAULT_CHECKPOINT,
    limit: Annotated[int, typer.Option(help="Scenes to plan for, of each file.", min=1)] = 1,
    skip: Annotated[int, typer.Option(help="Scenes to pass over first.", min=0)] = 0,
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("out"),
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
    with told():
        from model.driving.scene_store import read_scenes

        labelled = [
            scene
            for file in scenes or [DEFAULT_SCENES]
            for scene in islice(read_scenes(file, dense=False), skip, skip + limit)
        ]
        if not labelled:
            raise ValueError("there are no scenes to plan for")
        asyncio.run(
            _plan(
                labelled,
                checkpoint,
                out,
                as_json,
                {"route": route, "tracks": tracks},
                {"thinking": thinking, "n": n, "temperature": temperature, "seed": seed},
            )
        )


async def _plan(
    labelled: list[Any],
    checkpoint: Path,
    out: Path,
    as_json: bool,
    given: dict[str, bool],
    controls: dict[str, Any],
) -> None:
    import numpy as np

    from model.driving.trajectory import agreed
    from model.engines.engine import Controls, DrawFinished, PlanRequest
    from model.engines.torch.engine import TorchEngine
    from model.evaluation.pictures import plan_picture

    engine = TorchEngine(checkpoint)
    await engine.start()
    try:
        for scene in labelled:
            asked = scene.given(**given)
            request = PlanRequest(asked.scene_id, asked, controls=Controls(**controls))
            draws = [event.draw async for event in engine.submit(request) if isinstance(event, DrawFinished)]
            draws.sort(key=lambda draw: draw.index)
            picture = out / f"{asked.scene_id}.png"
            picture.parent.mkdir(parents=True, exist_ok=True)
            chosen = agreed(np.stack([draw.trajectory for draw in draws]))
            plan_picture(scene, draws, picture, shown=chosen)
            if as_json:
                typer.echo(json.dumps(_as_json(asked.scene_id, draws, chosen, picture)))
            else:
                draw = draws[chosen]
                typer.echo(f"scene {asked.scene_id}, draw {chosen} of {len(draws)}\n\n{draw.text}\n")
                if draw.think_probability is not None:
                    typer.echo(f"branch {draw.branch}  think probability {draw.think_probability:.3f}")
                end = draw.trajectory[-1]
                typer.echo(f"in 6.4 s at x {end[0]:.1f} m, y {end[1]:.1f} m; picture {picture}")
    finally:
        await engine.stop()


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
                "tokens": dict(draw.tokens),
            }
            for draw in draws
        ],
    }
