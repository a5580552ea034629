"""Labelled scenes to be sent, and setups to send them with."""

from __future__ import annotations

from functools import cache

from looktwice.loadtests.load_run import Setup
from looktwice.loadtests.mix import Mix
from looktwice.loadtests.sending import ServiceTarget
from looktwice.model.bundled import SCENES
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.scene_store import read_scenes


@cache
def labelled_scenes() -> tuple[LabelledScene, ...]:
    return tuple(read_scenes(SCENES, dense=False))


def setup(
    url: str, mix: Mix = Mix(), *, rate_rps: float = 20, seconds: float = 2, goal_s: float = 1
) -> Setup:
    """With a lag limit that even a busy machine keeps: tests are not about its speed."""
    return Setup(
        target=ServiceTarget(url, timeout_s=10),
        scenes=labelled_scenes(),
        mix=mix,
        rate_rps=rate_rps,
        seconds=seconds,
        warm_up_s=0.5,
        goal_s=goal_s,
        lag_limit_s=5,
        seed=1,
        workers=1,
        distinct=20,
        tell=lambda _: None,
    )
