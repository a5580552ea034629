"""`looktwice scenes`: make driving scenes in the simulator, count them, look at them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from looktwice.service.cli.options import DEFAULT_SCENES, Json, SmallBy, SmallInput, reported_errors

if TYPE_CHECKING:
    from looktwice.clients.importers.recording import Recording
    from looktwice.clients.importers.resampling import Source
    from looktwice.clients.metadrive.closed_loop import Pilot
    from looktwice.model.driving.cameras import CameraSpec
    from looktwice.model.driving.scene import LabelledScene

app = typer.Typer(help="Make, count and look at driving scenes.", no_args_is_help=True)
_Scenes = Annotated[Path, typer.Argument(help="Scene file or folder; the bundled scenes without one.")]


@app.command("generate")
def generate(
    out: Annotated[Path, typer.Argument(help="Folder for the scene files.")],
    first_seed: Annotated[int, typer.Option(help="Train < 500000 <= validation < 600000 <= test < 700000.")],
    episodes: Annotated[int, typer.Option(help="Episodes, one a seed.", min=1)],
    workers: Annotated[int, typer.Option(help="Processes that render.", min=1)] = 2,
    stride: Annotated[float, typer.Option(help="Seconds between the scenes of an episode.")] = 0.5,
    surround: Annotated[bool, typer.Option(help="Render the six surround cameras too.")] = False,
    next_frames: Annotated[
        bool, typer.Option(help="Store what every camera sees half a second later too, to be imagined.")
    ] = False,
    drifts: Annotated[
        bool, typer.Option(help="The expert strays now and then; scenes show how it comes back.")
    ] = False,
    lapses: Annotated[
        bool, typer.Option(help="The expert brakes late now and then; scenes show how it brakes then.")
    ] = False,
    speeds: Annotated[
        bool,
        typer.Option(
            help="In each scene the car is slower or faster than it was, and the expert goes on from there. "
            "Needs --no-dense --no-pictures."
        ),
    ] = False,
    width: Annotated[int, typer.Option(help="Width of the pictures in pixels, twice their height.")] = 224,
    dense: Annotated[
        bool,
        typer.Option(help="Store what each picture cell shows, which `ground` needs."),
    ] = True,
    service: Annotated[
        str | None,
        typer.Option(
            help="URL of a service whose model drives in the expert's place: scenes are of what it meets "
            "itself, with what the expert would do from there. Needs --no-dense."
        ),
    ] = None,
    small: Annotated[
        Path | None,
        typer.Option(help="Folder of a small planner (`train teacher`) that drives; else as --service."),
    ] = None,
    by: SmallBy = "tracks",
    tracks: Annotated[bool, typer.Option(help="Tell that model the tracks of the objects around.")] = False,
    careless: Annotated[
        bool,
        typer.Option(
            help="--small overlooks everybody for up to two seconds now and then, and sees late who stands."
        ),
    ] = False,
    teacher: Annotated[
        Path | None,
        typer.Option(
            help="Folder of a small planner of tracks that says what --small or --service should do, in the "
            "expert's place: at once, and in every moment."
        ),
    ] = None,
    hazards: Annotated[
        bool,
        typer.Option(
            help="Many hazards wait for --small or --service, and only moments with one ahead are stored."
        ),
    ] = False,
    pictures: Annotated[
        bool,
        typer.Option(help="Without, with --no-dense, scenes are made many times as fast."),
    ] = True,
) -> None:
    """Drive episodes in MetaDrive and store their scenes; run again after a kill, it resumes."""
    with reported_errors():
        from looktwice.clients.metadrive.generation import GenerateConfig, generate

        if careless and (small is None or by == "pictures"):
            raise ValueError("--careless is for --small, where it plans from tracks or facts")
        if by != "tracks" and small is None:
            raise ValueError("--by is for --small")
        if by == "pictures" and not pictures:
            raise ValueError("--by pictures needs pictures")
        driver, pilot = _driver(service, small, by=by, tracks=tracks, pictures=pictures)
        says, taught_by = _driver(None, teacher, by="tracks", tracks=True, pictures=False)
        if says is not None and not says.startswith("teacher "):
            raise ValueError(
                f"--teacher has to plan from tracks, and {teacher} holds a planner that does not"
            )
        config = GenerateConfig(
            stride_s=stride,
            surround=surround,
            next_frames=next_frames,
            dense=dense,
            drifts=drifts,
            lapses=lapses,
            speeds=speeds,
            width_px=width,
            driver=driver,
            tracks=tracks,
            careless=careless,
            pictures=pictures,
            teacher=says,
            hazards=hazards,
        )
        seeds = range(first_seed, first_seed + episodes)
        report = generate(out, seeds, workers=workers, config=config, pilot=pilot, teacher=taught_by)
        typer.echo(str(report))


def _driver(
    service: str | None, small: Path | None, *, by: SmallInput, tracks: bool, pictures: bool
) -> tuple[str | None, Callable[[], Pilot] | None]:
    """Who drives in the expert's place, with revision, and what makes it in a worker; None for nobody."""
    from looktwice.clients.planner import Access, PlannerClient
    from looktwice.service.cli.small_pilot import SmallPilot

    if service is not None and small is not None:
        raise ValueError("either --service or --small drives, not both")
    if small is not None:
        makes = partial(SmallPilot, small, by)
        return makes().described, makes
    if service is None:
        return None, None
    if not pictures:
        raise ValueError("a served model looks at pictures: --no-pictures is for --small")
    with PlannerClient(service, access=Access.from_environment()) as planner:
        cards = planner.models()
    name = ", ".join(f"{card.name} {card.revision}" for card in cards)
    thinks = not all("never" in card.thinking_in(None) for card in cards)
    return name, partial(served_pilot, service, tracks=tracks, thinks=thinks)


def served_pilot(service: str, *, tracks: bool, thinks: bool = False) -> Pilot:
    """A service's model, without second looks: those are taught by what comes of first plans.

    Args:
        service: its URL.
        tracks: whether it is told them.
        thinks: it cannot be asked to do without.
    """
    from looktwice.clients import wire
    from looktwice.clients.metadrive.closed_loop import ServicePilot
    from looktwice.clients.planner import Access, PlannerClient, RetryPolicy

    planner = PlannerClient(service, RetryPolicy(timeout_s=120.0), access=Access.from_environment())
    thinking: wire.Thinking = "adaptive" if thinks else "never"
    return ServicePilot(planner, thinking, wire.Controls(n=6, thinking=thinking), tracks=tracks)


@app.command("import")
def import_(
    folder: Annotated[
        Path,
        typer.Argument(
            help="A drive: poses.csv and a folder of pictures a camera; or nuScenes; or comma2k19."
        ),
    ],
    out: Annotated[Path, typer.Argument(help="Scene file to write.")],
    camera: Annotated[
        list[str] | None,
        typer.Option(
            help="CAMERA=FOLDER:DEGREES[:HORIZON[:DEGREES_DOWN]], once a camera: where its pictures are, "
            "what they show from side to side, where the horizon lies (0.5 is half-way down), and what they "
            "show from top to bottom, for pictures whose pixels are not square.",
            show_default="folders named like the model's two cameras",
        ),
    ] = None,
    stride: Annotated[float, typer.Option(help="Seconds from scene to scene.", min=0.1)] = 0.5,
    route: Annotated[bool, typer.Option(help="Take the way that was driven for the route.")] = False,
    width: Annotated[int, typer.Option(help="Width of the pictures in pixels, twice their height.")] = 336,
) -> None:
    """Make scenes of recorded drives, your own or others'; docs/own-cameras.md tells how."""
    with reported_errors():
        from looktwice.clients.importers.recording import RecordingError
        from looktwice.model.driving.scene_store import write_scenes

        doubts: set[str] = set()

        def scenes() -> Iterator[LabelledScene]:
            for recording in _recordings(folder, camera or [], width):
                for doubt in recording.doubts():
                    if doubt not in doubts:
                        typer.echo(f"looktwice: {doubt}", err=True)
                        doubts.add(doubt)
                yield from recording.scenes(stride_s=stride, route=route)

        count = write_scenes(out, scenes())
        if not count:
            out.unlink()
            raise RecordingError(
                f"{folder} holds no scene: that takes four pictures of each camera half a second apart, and "
                "poses from 1.5 s before the last of them to 6.4 s after it. One is looked for every "
                f"{stride:g} s from 1.5 s after the first pose on: try --stride 0.1 where pictures are few"
            )
        typer.echo(f"{count} {'scene' if count == 1 else 'scenes'} in {out}")


def _recordings(folder: Path, told: list[str], width: int) -> Iterable[Recording]:
    """Of whichever layout the folder has."""
    from looktwice.clients.importers.comma2k19 import POSES_FOLDER, read_segments
    from looktwice.clients.importers.folder import POSES_FILE, read_folder
    from looktwice.clients.importers.nuscenes import VERSIONS, read_nuscenes
    from looktwice.model.driving.cameras import FRONT_CAMERAS

    specs = [spec.resized(width) for spec in FRONT_CAMERAS]
    if any(folder.glob(VERSIONS)):
        others = read_nuscenes(folder, specs)
    elif not (folder / POSES_FILE).exists() and any(folder.rglob(POSES_FOLDER)):
        others = read_segments(folder, specs)
    else:
        return [read_folder(folder, _played(told, specs))]
    if told:
        raise ValueError("--camera is for a folder of your own; nuScenes and comma2k19 tell of their cameras")
    return others


def _played(told: list[str], specs: list[CameraSpec]) -> dict[CameraSpec, Source]:
    from looktwice.clients.importers.recording import RecordingError
    from looktwice.clients.importers.resampling import Source

    if not told:
        return {spec: Source(spec.name, spec.hfov_degrees, spec.horizon) for spec in specs}
    named = {spec.name: spec for spec in specs}
    found = {}
    for each in told:
        name, _, source = each.partition("=")
        try:
            folder, *numbers = source.split(":")
            degrees, horizon, *down = [*map(float, numbers), 0.5][: max(2, len(numbers))]
            found[named[name]] = Source(folder, degrees, horizon, vfov_degrees=down[0] if down else None)
        except (KeyError, ValueError) as error:
            if isinstance(error, RecordingError):
                raise
            form = "CAMERA=FOLDER:DEGREES[:HORIZON[:DEGREES_DOWN]]"
            raise ValueError(f"{each!r} is no {form}; known are {', '.join(named)}") from None
    return found


@app.command("stats")
def stats(path: _Scenes = DEFAULT_SCENES, as_json: Json = False) -> None:
    """Count scenes per tag and per meta-action, and check the expert."""
    with reported_errors():
        from looktwice.clients.summaries.stats import scene_stats

        figures = scene_stats(path)
        if as_json:
            typer.echo(json.dumps(figures))
            return
        for name, value in figures.items():
            if isinstance(value, dict):
                typer.echo(name)
                for key, count in value.items():
                    typer.echo(f"  {key:24} {count}")
            else:
                typer.echo(f"{name:26} {value}")


@app.command("short-term")
def short_term(
    train: Annotated[Path, typer.Argument(help="Scene file or folder that lambda is fitted on.")],
    validation: Annotated[Path, typer.Argument(help="Scene file or folder that it is measured on.")],
    as_json: Json = False,
) -> None:
    """Measure how far off half a second ahead is predicted: VLA-World's short-term predictor."""
    with reported_errors():
        from looktwice.clients.summaries.short_term_errors import format_short_term, short_term_figures

        figures = short_term_figures(train, validation)
        typer.echo(json.dumps(figures) if as_json else format_short_term(figures))


@app.command("show")
def show(
    path: _Scenes = DEFAULT_SCENES,
    out: Annotated[Path, typer.Option(help="Picture to write.")] = Path("out/scenes.png"),
    limit: Annotated[int, typer.Option(help="How many scenes.", min=1)] = 12,
    every: Annotated[int, typer.Option(help="Take every so-many-th scene.", min=1)] = 1,
) -> None:
    """Write a contact sheet: cameras and bird's-eye view of scenes."""
    with reported_errors():
        from looktwice.clients.summaries.sheet import contact_sheet
        from looktwice.model.driving.scene_store import read_scenes

        out.parent.mkdir(parents=True, exist_ok=True)
        contact_sheet(islice(read_scenes(path), 0, limit * every, every), out)
        typer.echo(str(out))


@app.command("pick")
def pick(
    path: Annotated[Path, typer.Argument(help="Scene file or folder.")],
    out: Annotated[Path, typer.Argument(help="Scene file to write.")],
    count: Annotated[int, typer.Option(help="How many scenes.", min=1)] = 12,
) -> None:
    """Pick a few scenes that show every tag, each from another episode, without their dense targets."""
    with reported_errors():
        from looktwice.model.driving.scene_store import read_scenes, write_scenes
        from looktwice.model.driving.selection import pick_varied

        chosen = pick_varied(read_scenes(path, dense=False), count)
        typer.echo(f"{write_scenes(out, chosen)} scenes in {out}")
