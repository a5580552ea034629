"""Variants of an evaluation, and an engine driven through one of them."""

from __future__ import annotations

import asyncio
import zlib
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, TypeVar

import numpy as np

from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.scene import Clip, LabelledScene
from looktwice.model.engines.engine import (
    Controls,
    Draw,
    DrawFinished,
    Engine,
    EngineError,
    PlanRequest,
)
from looktwice.model.evaluation.open_loop import SceneResult, evaluate_draws
from looktwice.model.families.registry import family_named

_Scene = TypeVar("_Scene")
_Found = TypeVar("_Found")

SPEED_FACTORS: Final = (0.5, 1.5)
"""A planner that copies its speed goes as much slower or faster as its history; the expert does not."""


@dataclass(frozen=True)
class Variant:
    """How scenes are put to an engine.

    Attributes:
        name: of the row.
        format: the response format asked for.
        controls: of every request; the seed is varied from scene to scene, alike in all variants.
        route: whether the scene's route is given.
        tracks: whether the tracks of its agents are given.
        expert_plan: the expert's plan is given as the first plan.
        greedy: the likeliest response is asked for too.
        speed: the history is driven at so many times its speed.
        next_camera: a camera is asked for whose picture half a second later the scene brings, another one
            from scene to scene.
        picture: tells the 98 codes that are given for that camera's picture; None where the model writes it.
        shuffled_images: scenes get the clips of scenes from other episodes: a planner that looks gets worse.
    """

    name: str
    format: str
    controls: Controls = field(default_factory=Controls)
    route: bool = False
    tracks: bool = False
    expert_plan: bool = False
    shuffled_images: bool = False
    greedy: bool = False
    speed: float = 1.0
    next_camera: bool = False
    picture: Callable[[LabelledScene], tuple[int, ...]] | None = None


def standard_variants(
    formats: Sequence[str], controls: Controls = Controls(), inputs: Sequence[str] = ("route",)
) -> list[Variant]:
    """The open-loop table's rows for a checkpoint that writes ``formats`` and takes ``inputs``."""
    no_branch = replace(controls, thinking="adaptive", think_threshold=None)
    # Scenes bring no attempt to be refined.
    families = [family for family in map(family_named, formats) if not family.refines]
    families.sort(key=lambda family: family.first_plan is not None)
    variants = []
    given = [("", False, False), (" + route", True, False), (" + route + tracks", True, True)]
    for suffix, route, tracks in given if "tracks" in inputs else given[:2]:
        for family in families:
            title = f"{family.title or family.name}{suffix}"
            plain = Variant(
                title, family.name, controls if family.branch else no_branch, route=route, tracks=tracks
            )
            if family.first_plan is None:
                variants.append(plain)
                continue
            variants += [
                replace(plain, greedy=True),
                replace(plain, name=f"{title}, expert plan", expert_plan=True),
                replace(plain, name=f"{title}, shuffled images", shuffled_images=True),
            ]
            if route:
                variants += [
                    replace(plain, name=f"{title}, speed x {factor:g}", speed=factor)
                    for factor in SPEED_FACTORS
                ]
    return variants


def check_variants(scenes: Sequence[LabelledScene], variants: Iterable[Variant]) -> None:
    """Refuse what scenes do not allow, before anything is planned.

    Raises:
        ValueError: no scenes; a variant that they do not allow.
    """
    if not scenes:
        raise ValueError("there are no scenes to evaluate on")
    for variant in variants:
        if variant.shuffled_images:
            _longest([labelled.episode_id for labelled in scenes])
        for labelled in scenes:
            _check_scene(labelled, variant)


async def evaluate_engine(
    engine: Engine,
    scenes: Iterable[LabelledScene],
    variant: Variant,
    *,
    concurrency: int = 16,
    on_result: Callable[[SceneResult], None] | None = None,
    on_draws: Callable[[LabelledScene, Sequence[Draw]], None] | None = None,
) -> list[SceneResult]:
    """Plan for every scene and return the results in the scenes' order.

    Args:
        engine: started.
        scenes: taken one by one, so they may be read from files as they are needed; with shuffled images
            they are gone through twice.
        variant: what to ask for.
        concurrency: how many scenes are under way at once.
        on_result: called after each scene, for progress.
        on_draws: called with each scene's draws.

    Raises:
        EngineError, RequestError: the engine's.
        ValueError: a variant that the scenes do not allow.
    """

    async def work(labelled: LabelledScene) -> SceneResult:
        draws = await planned(engine, request_for(labelled, variant))
        greedy = await planned(engine, greedy_request(labelled, variant)) if variant.greedy else [None]
        result = evaluate_draws(labelled, draws, greedy[0])
        if on_draws is not None:
            on_draws(labelled, draws)
        if on_result is not None:
            on_result(result)
        return result

    source = with_shuffled_images(scenes) if variant.shuffled_images else scenes
    return await over_scenes(source, work, concurrency)


async def over_scenes(
    scenes: Iterable[_Scene], work: Callable[[_Scene], Awaitable[_Found]], concurrency: int
) -> list[_Found]:
    """What ``work`` makes of each scene, in their order, so many under way at once.

    Scenes are taken one by one. What ``work`` raises ends all.
    """
    numbered = enumerate(scenes)
    one_reader = asyncio.Lock()
    results: dict[int, _Found] = {}

    async def take() -> None:
        while True:
            async with one_reader:
                # Reading and decompressing takes a while; the engine shares this event loop.
                item = await asyncio.to_thread(next, numbered, None)
            if item is None:
                return
            index, scene = item
            results[index] = await work(scene)

    try:
        async with asyncio.TaskGroup() as group:
            for _ in range(concurrency):
                group.create_task(take())
    except ExceptionGroup as failures:
        raise failures.exceptions[0] from None
    return [results[index] for index in range(len(results))]


async def planned(engine: Engine, request: PlanRequest) -> list[Draw]:
    """The draws of a request in order; raises `EngineError` where some are missing."""
    draws = [event.draw async for event in engine.submit(request) if isinstance(event, DrawFinished)]
    if len(draws) != request.controls.n:
        raise EngineError(f"{request.request_id}: {len(draws)} draws came for {request.controls.n}")
    return sorted(draws, key=lambda draw: draw.index)


def request_for(labelled: LabelledScene, variant: Variant) -> PlanRequest:
    """What the engine is asked for a scene (with shuffled images: one that has them already)."""
    _check_scene(labelled, variant)
    scene = labelled.scene
    # A draw's random numbers depend on the seed alone: one seed for all scenes would give all the same
    # luck. A seed from the scene's name does not, and variants still meet the same luck in the same scene.
    seed = variant.controls.seed ^ zlib.crc32(scene.scene_id.encode())
    given = labelled.at_speed(variant.speed).given(route=variant.route, tracks=variant.tracks)
    return PlanRequest(
        request_id=f"{variant.name}/{scene.scene_id}",
        scene=given,
        format=variant.format,
        controls=replace(
            variant.controls,
            seed=seed,
            prefill=expert_plan(labelled) if variant.expert_plan else variant.controls.prefill,
            camera=next_camera(labelled) if variant.next_camera else variant.controls.camera,
            picture=None if variant.picture is None else variant.picture(labelled),
        ),
    )


def _check_scene(labelled: LabelledScene, variant: Variant) -> None:
    if variant.route and labelled.scene.route is None:
        raise ValueError(f"{variant.name}: scene {labelled.scene.scene_id} has no route")
    if variant.next_camera:
        next_camera(labelled)


def next_camera(labelled: LabelledScene) -> str:
    """The camera whose next picture is asked for: one that the scene shows now and half a second later.

    Which one follows from the scene's name. Raises ValueError where there is none.
    """
    scene_id, cameras = labelled.scene.scene_id, cameras_ahead(labelled)
    if not cameras:
        raise ValueError(
            f"scene {scene_id} brings no picture half a second ahead: "
            "`looktwice scenes generate --next-frames` makes such scenes"
        )
    return cameras[zlib.crc32(f"camera of {scene_id}".encode()) % len(cameras)]


def cameras_ahead(labelled: LabelledScene) -> list[str]:
    """The cameras that a scene shows now and half a second later."""
    shown = {clip.camera for clip in labelled.scene.clips}
    return [frame.camera for frame in labelled.next_frames if frame.camera in shown]


def greedy_request(labelled: LabelledScene, variant: Variant) -> PlanRequest:
    """The request for the likeliest response alone."""
    request = request_for(labelled, variant)
    controls = replace(request.controls, n=1, temperature=0.0)
    return replace(request, request_id=f"{request.request_id}/greedy", controls=controls)


def with_shuffled_images(scenes: Iterable[LabelledScene], seed: int = 0) -> Iterator[LabelledScene]:
    """Scenes whose clips come from scenes of other episodes; each scene's clips are used once.

    Raises:
        ValueError: scenes that can be gone through only once, or half of which are of one episode.
    """
    if isinstance(scenes, Iterator):
        raise ValueError("shuffling needs scenes that can be gone through twice")
    clips: list[tuple[Clip, ...]] = []
    episodes: list[str] = []
    for labelled in scenes:
        clips.append(labelled.scene.clips)
        episodes.append(labelled.episode_id)
    for labelled, donor in zip(scenes, donors(episodes, seed), strict=True):
        yield replace(labelled, scene=replace(labelled.scene, clips=clips[donor]))


def donors(episodes: Sequence[str], seed: int) -> list[int]:
    """A permutation that maps every place to a place of another episode.

    Episodes in random order, laid end to end and moved on by the longest one's length: nobody can stay within
    the own episode, provided that no episode is longer than half of the whole.
    """
    random = np.random.default_rng(seed)
    rank = {episode: position for position, episode in enumerate(random.permutation(sorted(set(episodes))))}
    order = sorted(random.permutation(len(episodes)).tolist(), key=lambda index: rank[episodes[index]])
    longest = _longest(episodes)
    found = [0] * len(order)
    for position, index in enumerate(order):
        found[index] = order[(position + longest) % len(order)]
    return found


def _longest(episodes: Sequence[str]) -> int:
    """How many scenes the longest episode has; raises ValueError where that is more than all others have."""
    longest = max(Counter(episodes).values(), default=0)
    if 2 * longest > len(episodes):
        raise ValueError(
            "shuffled images come from other episodes, so no episode may have more than half of the scenes; "
            f"of these {len(episodes)} one has {longest}: take more scenes, or others"
        )
    return longest
