"""What a planner sends tick by tick: clips that slide on with time, as consecutive requests of one car do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from loadtests.bodies import make_call
from loadtests.call import Call
from loadtests.mix import Mix
from model.driving.scene import CLIP_FRAMES, CLIP_PERIOD_S, Clip, LabelledScene, Scene
from model.driving.trajectory import STEP_S
from model.driving.variations import fresh, moved


def make_drives(
    scenes: Sequence[LabelledScene], mix: Mix, planners: int, hz: float, seconds: float, seed: int
) -> list[list[Call]]:
    """The calls of each planner; every planner asks for one kind of request throughout.

    Raises:
        ValueError: there are no scenes, or ``hz`` does not divide 10.
    """
    if not scenes:
        raise ValueError("a fleet needs scenes to drive through")
    drives = []
    for planner, kind in enumerate(mix.kinds(planners, seed)):
        labelled = scenes[planner % len(scenes)]
        seen = drive(labelled.scene, (seed * planners + planner) * 1_000_003, hz, seconds)
        drives.append([make_call(kind, [replace(labelled, scene=scene)], planner) for scene in seen])
    return drives


def drive(scene: Scene, number: int, hz: float, seconds: float) -> list[Scene]:
    """Scenes of a car that drives on from ``scene``, one for each tick.

    The ego history moves on at every tick. Cameras are slower: every 0.5 s a clip loses its oldest picture
    and gets a new one, so scenes within half a second share all pictures and then three of four.

    Args:
        scene: where it begins.
        number: tells the pictures of one drive from those of all others.
        hz: ticks per second, a divisor of 10.
        seconds: how long.

    Raises:
        ValueError: histories, which are at 10 Hz, cannot move on at ``hz``.
    """
    steps = round(1 / (hz * STEP_S))
    if steps < 1 or abs(steps * hz * STEP_S - 1) > 1e-9:
        raise ValueError(f"planners ask at 10, 5, 2 or 1 Hz, in step with their histories; not at {hz:g} Hz")
    ticks = round(seconds * hz)
    slides = int(ticks / hz / CLIP_PERIOD_S) + 1
    rolls = _rolls(scene, number, CLIP_FRAMES + slides)
    driven, position = [], scene
    for tick in range(ticks):
        slide = int(tick / hz / CLIP_PERIOD_S + 1e-9)
        clips = tuple(Clip(camera, roll[slide : slide + CLIP_FRAMES]) for camera, roll in rolls.items())
        driven.append(replace(position, scene_id=f"{scene.scene_id}-{number}-{tick}", clips=clips))
        position = moved(position, steps)
    return driven


def _rolls(scene: Scene, number: int, pictures: int) -> dict[str, tuple[bytes, ...]]:
    """So many pictures of every camera, no two alike: the scene's own, over and over, each time new."""
    rounds = [fresh(scene, number + turn) for turn in range(-(-pictures // CLIP_FRAMES))]
    return {
        clip.camera: tuple(image for turn in rounds for image in turn.clip(clip.camera).images)[:pictures]
        for clip in scene.clips
    }
