"""How fast plans are scored, beside NAVSIM's own scorer in the same world."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np

from looktwice.model.bench.navsim_scorer import NavsimScorer
from looktwice.model.driving.pdm.scoring import Others, score
from looktwice.model.driving.pdm.world import SPEED, STATE_SIZE, Area, Array, Lane, TrackedBox, World

FEW: Final = 6
MANY: Final = 4096
NAVSIM_PLANS: Final = 32
_AGENTS: Final = 12
_WIDTH_M: Final = 3.6


@dataclass(frozen=True)
class ScoringSpeed:
    """Seconds of processor time on one core, and what NAVSIM takes for a plan where it was run.

    Attributes:
        seconds_6, seconds_4096: for so many plans of one scene.
        navsim_seconds_a_plan: of as many plans at once as `NAVSIM_PLANS` says; None without a checkout.
        times_navsim: how many times as fast a plan of 4,096 is; None without a checkout.
    """

    seconds_6: float
    seconds_4096: float
    navsim_seconds_a_plan: float | None
    times_navsim: float | None

    def to_json(self) -> dict[str, float | None]:
        """Its fields."""
        return asdict(self)


def measure(repeats: int, navsim: Sequence[Path], navsim_python: Path | None) -> ScoringSpeed:
    """Score plans of a scene with 12 agents, four lanes and an intersection, by the rules of v2.2.

    Args:
        repeats: measured rounds, ten times as many of few plans; the best one counts.
        navsim: folders that hold the packages ``navsim`` and ``nuplan``; none leaves NAVSIM out.
        navsim_python: an interpreter that has what NAVSIM needs; this one where it is None.

    Raises:
        RuntimeError: NAVSIM does not run there.
    """

    def ours(count: int, repeats: int) -> float:
        world, plans = scene(count)
        others = Others(reference=plans[0])
        return _seconds(lambda: score(world, plans, "v2.2", others), repeats)

    few, many = ours(FEW, 10 * repeats), ours(MANY, repeats)
    theirs = _navsim_seconds(repeats, navsim, navsim_python) if navsim else None
    times = None if theirs is None else theirs / (many / MANY)
    return ScoringSpeed(few, many, theirs, times)


def scene(count: int) -> tuple[World, Array]:
    """A world that bends to the left, and ``count`` plans in it."""
    radius = 120.0

    def at(along: float, left: float) -> list[float]:
        turned = along / radius
        return [(radius - left) * math.sin(turned), radius - (radius - left) * math.cos(turned)]

    def strip(start: float, end: float, right: float, left: float) -> Area:
        alongs = np.linspace(start, end, 20).tolist()
        ring = [at(along, right) for along in alongs] + [at(along, left) for along in reversed(alongs)]
        return Area((np.array(ring),))

    def track(number: int) -> TrackedBox:
        pace, begin = 3.0 + number % 4, 14.0 + 9.0 * (number // 3)
        side = (number % 3 - 1) * _WIDTH_M
        poses = np.zeros((51, 3))
        for step in range(51):
            along = begin + 0.1 * step * pace
            poses[step] = *at(along, side), along / radius
        return TrackedBox(str(number), True, 4.6, 1.9, poses, pace)

    ego = np.zeros(STATE_SIZE)
    ego[SPEED] = 8.0
    past = np.zeros((15, STATE_SIZE))
    sides = [((number - 0.5) * _WIDTH_M, (number + 0.5) * _WIDTH_M) for number in range(-1, 3)]
    spans = ((-25.0, 28.0), (28.0, 46.0), (46.0, 110.0))
    lanes = tuple(
        Lane(f"{span}_{side}", strip(*spans[span], *sides[side]), side < 3)
        for span in range(3)
        for side in range(4)
    )
    world = World(
        ego,
        tracks=tuple(track(number) for number in range(_AGENTS)),
        lanes=lanes,
        intersections=(strip(28.0, 46.0, -16.0, 20.0),),
        drivable=tuple(strip(*spans[span], sides[0][0] - 0.5, sides[3][1] + 0.5) for span in (0, 2)),
        lights=(),
        centreline=np.array([at(along, 0.0) for along in np.arange(-25.0, 110.0, 1.0)]),
        past=past,
    )
    dice = np.random.default_rng(0)
    t = np.arange(1, 9) * 0.5
    along = np.clip(8.0 + dice.uniform(-4, 3, (count, 1)), 0, None) * t
    left = dice.uniform(-4, 4, (count, 1)) * np.clip(t / 3, 0, 1)
    turned = along / radius
    x, y = (radius - left) * np.sin(turned), radius - (radius - left) * np.cos(turned)
    return world, np.stack([x, y, turned], axis=-1)


def _seconds(work: Callable[[], object], repeats: int) -> float:
    """The least processor seconds of a round: what others take of the caches only ever adds to them."""
    work()
    found = []
    for _ in range(repeats):
        began = time.process_time()
        work()
        found.append(time.process_time() - began)
    return min(found)


def _navsim_seconds(repeats: int, folders: Sequence[Path], python: Path | None) -> float:
    command = [
        str(python or sys.executable),
        "-m",
        "looktwice.model.bench.scoring_speed",
        str(repeats),
        *map(str, folders),
    ]
    root = Path(__file__).parents[__name__.count(".")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=root, check=False)
    if done.returncode:
        raise RuntimeError(f"NAVSIM does not run: {done.stderr.strip()[-2000:]}")
    return float(json.loads(done.stdout.splitlines()[-1]))


def _main(repeats: int, folders: list[Path]) -> None:
    oracle = NavsimScorer("v2.2", folders)
    world, plans = scene(NAVSIM_PLANS)
    given = list(plans)
    spent = _seconds(lambda: oracle.score(world, oracle.simulate(world, given)), repeats)
    print(json.dumps(spent / NAVSIM_PLANS))


if __name__ == "__main__":
    _main(int(sys.argv[1]), list(map(Path, sys.argv[2:])))
