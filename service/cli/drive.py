"""`looktwice drive`: a car in the simulator that drives through the HTTP API alone."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Final, cast

import typer

from looktwice.service.cli.options import Json, SmallBy, SmallPlanners, reported_errors
from looktwice.service.cli.progress import progress_on_stderr

SERVICE_DRIVERS: Final = ("adaptive", "never", "always")
DRIVERS: Final = ("expert", "constant-velocity", *SERVICE_DRIVERS)


def drive(
    service: Annotated[str, typer.Option(help="URL of a running service.")] = "http://127.0.0.1:8000",
    episodes: Annotated[int, typer.Option(help="How many, each with its own seed.", min=1)] = 30,
    first_seed: Annotated[int, typer.Option(help="Seeds from 600000 on are for testing.", min=0)] = 600_000,
    seconds: Annotated[float, typer.Option(help="Of an episode, at most.", min=5)] = 30.0,
    drivers: Annotated[
        list[str] | None, typer.Option("--driver", help=f"Once for each of {', '.join(DRIVERS)}.")
    ] = None,
    n: Annotated[int, typer.Option(help="Draws; the car follows the one nearest to the others.", min=1)] = 6,
    temperature: Annotated[float, typer.Option(help="Of sampling.", min=0, max=2)] = 1.0,
    think_threshold: Annotated[
        float | None,
        typer.Option(help="adaptive thinks where the probability exceeds it, not by chance.", min=0, max=1),
    ] = None,
    deadline_ms: Annotated[int | None, typer.Option(help="That each plan has.", min=1)] = None,
    route: Annotated[bool, typer.Option(help="Tell the model the route.")] = True,
    tracks: Annotated[bool, typer.Option(help="Tell the model the tracks of the objects around.")] = False,
    format: Annotated[str | None, typer.Option(help="Response format; the model's first by default.")] = None,
    small: SmallPlanners = None,
    by: SmallBy = "tracks",
    keep: Annotated[
        Path | None, typer.Option(help="File that keeps every drive: started again, it goes on behind them.")
    ] = None,
    gif: Annotated[Path | None, typer.Option(help="Film of the first episode of the last driver.")] = None,
    as_json: Json = False,
) -> None:
    """Drive closed loop, planning anew every half second; expert and constant velocity are the limits."""
    if by != "tracks" and not small:
        raise typer.BadParameter("it is for --small", param_hint="--by")
    if gif is not None and gif.suffix.lower() != ".gif":
        raise typer.BadParameter(f"{gif} does not end in .gif", param_hint="--gif")

    from looktwice.clients import wire
    from looktwice.clients.metadrive.closed_loop import (
        EXPERT,
        IMAGINED,
        ConstantVelocity,
        Drive,
        DriveConfig,
        Film,
        MapError,
        Pilot,
        Rig,
        ServicePilot,
        drive_store,
        driver_comparisons,
        driver_rows,
        drives_to_json,
        format_driver_rows,
    )
    from looktwice.clients.metadrive.closed_loop import drive as drive_episode
    from looktwice.clients.planner import Access, PlannerClient, RetryPolicy
    from looktwice.model.driving.cameras import FRONT_CAMERAS
    from looktwice.model.driving.hashing import hash_of
    from looktwice.model.driving.scene import split_of_seed
    from looktwice.service.cli.small_pilot import load_pilots

    def pilot_of(driver: str, planner: PlannerClient, *, imagines: bool) -> Pilot | None:
        if driver == "expert":
            return None
        if driver == "constant-velocity":
            return ConstantVelocity()
        if driver in small_pilots:
            return small_pilots[driver]
        return ServicePilot(
            planner,
            driver,
            controls_of(driver),
            route=route,
            tracks=tracks,
            format=format,
            imagines=IMAGINED if imagines else None,
        )

    def controls_of(driver: str) -> wire.Controls:
        return wire.Controls(
            n=n,
            temperature=temperature,
            thinking=cast(wire.Thinking, driver),
            think_threshold=think_threshold if driver == "adaptive" else None,
            deadline_ms=deadline_ms,
        )

    def key_of(driver: str, seed: int, models: list[str]) -> str:
        if driver in small_pilots:
            # Its name may be that of its folder, which says nothing of how it drives.
            return hash_of(small_pilots[driver].kind, seed, seconds, small_pilots[driver].revision)
        if driver in ("expert", "constant-velocity"):
            return hash_of(driver, seed, seconds)
        asked = controls_of(driver).model_dump_json()
        formats = () if format is None else (format,)
        return hash_of(driver, seed, seconds, asked, route, tracks, models, width_px, *formats)

    with reported_errors():
        small_pilots = load_pilots(small or (), by)
    wanted = [*(drivers or ([] if small else DRIVERS[:-1])), *small_pilots]
    asks = any(driver in SERVICE_DRIVERS for driver in wanted)
    if unknown := set(drivers or ()) - set(DRIVERS):
        raise typer.BadParameter(f"unknown drivers: {', '.join(sorted(unknown))}")
    if len(set(wanted)) < len(wanted):
        raise typer.BadParameter("the same driver is named twice", param_hint="--driver")
    with (
        reported_errors(),
        _named(service),
        PlannerClient(service, RetryPolicy(timeout_s=120.0), access=Access.from_environment()) as planner,
    ):
        seeds = range(first_seed, first_seed + episodes)
        for seed in (seeds[0], seeds[-1]):
            split_of_seed(seed)
        cards = planner.models() if asks else []
        if not drivers:
            # By default, of the model's drivers those that its format can be asked for.
            known = {each for card in cards for each in card.thinking_in(format)}
            wanted = [each for each in wanted if each not in SERVICE_DRIVERS or each in known]
        models = [card.revision for card in cards]
        widths_px = [card.image_size[0] for card in cards]
        widths_px += [pilot.width_px for pilot in small_pilots.values()]
        width_px = max(widths_px, default=0) or FRONT_CAMERAS[0].width
        rig = Rig.of_width(width_px)
        imagines = wanted[-1] in SERVICE_DRIVERS and any(card.imagines and card.paints for card in cards)
        film, config = Film(imagines=imagines), DriveConfig(seconds)
        store = drive_store(keep) if keep is not None else None
        found: dict[str, list[Drive]] = {}
        with progress_on_stderr(quiet=as_json) as progress:
            task = progress.add_task("", total=len(seeds) * len(wanted))
            for seed in seeds:
                for driver in wanted:
                    filmed = gif is not None and seed == seeds[0] and driver == wanted[-1]
                    pilot = pilot_of(driver, planner, imagines=filmed and imagines)
                    name = EXPERT if pilot is None else pilot.name
                    key = key_of(driver, seed, models)
                    drove = store.find(key) if store is not None and not filmed else None
                    try:
                        if drove is None:
                            drove = drive_episode(seed, pilot, rig, config, film.add if filmed else None)
                            if store is not None:
                                store.store(key, drove)
                    except MapError:
                        typer.echo(f"no map fits seed {seed}: left out", err=True)
                        break
                    found.setdefault(name, []).append(drove)
                    progress.update(task, advance=1, description=f"{name}: {drove.ended}")
        if gif is not None:
            film.save(gif)
        if as_json:
            typer.echo(json.dumps(drives_to_json(found)))
        else:
            typer.echo(format_driver_rows(driver_rows(found), driver_comparisons(found)))


@contextmanager
def _named(service: str) -> Iterator[None]:
    """Turn what a service refuses, or that nothing answers, into an error that says which."""
    from looktwice.clients.answers import PlannerError

    try:
        yield
    except PlannerError as error:
        raise RuntimeError(f"{service}: {error}") from error
