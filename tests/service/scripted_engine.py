"""An engine without a network: plausible draws by rule, and failures, delays and refusals on demand."""

from __future__ import annotations

import asyncio
import random
from collections.abc import AsyncGenerator, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.perceived import Perceived, PerceivedAgent
from looktwice.model.driving.plan import GROUPS, Plan, parse_plan
from looktwice.model.driving.trajectory import (
    FUTURE_STEPS,
    STEP_S,
    TEN_HZ_S,
    FloatArray,
    at_times,
    present_speed,
)
from looktwice.model.engines.engine import (
    CodesWritten,
    Cut,
    DraftFinished,
    Draw,
    DrawFinished,
    EngineError,
    EngineLoad,
    Event,
    PlanRequest,
    RequestError,
    SectionFinished,
    Started,
    TextWritten,
)
from looktwice.model.families.family import Foreseen, NextPicture
from looktwice.model.families.picture_codes import beside
from looktwice.model.formats.pieces import Value
from looktwice.model.network.card import read_card
from looktwice.model.network.model_card import ModelCard

CARD: Final = ModelCard(
    name="scripted",
    revision="r1",
    engine="scripted",
    formats=("cf_vla", "traj_only"),
    cameras=("front_wide_120", "front_tele_30"),
    image_size=(224, 128),
    parameters=0,
)
KEEP_ON: Final = parse_plan(
    "- longitudinal\n  - 0.0s-2.1s: Keep Speed\n  - 2.1s-6.4s: Accelerate\n"
    "- lateral\n  - 0.0s-6.4s: Straight\n- lane\n  - 0.0s-6.4s: Keep Lane\n"
)
SLOW_DOWN: Final = parse_plan(
    "- longitudinal\n  - 0.0s-0.9s: Keep Speed\n  - 0.9s-4.8s: Decelerate\n  - 4.8s-6.4s: Keep Speed\n"
    "- lateral\n  - 0.0s-6.4s: Straight\n- lane\n  - 0.0s-2.4s: Keep Lane\n  - 2.4s-6.4s: Left Lane Change\n"
)
REASONING: Final = (
    "The vehicle ahead in our lane is slower and its brake lights are on. Accelerating from 2.1 s would "
    "close the gap before the left lane opens, so ease off now and change to the left lane once it is clear."
)
_ACCELERATION: Final = {"Accelerate": 1.2, "Decelerate": -1.6}
_LANE_SHIFT_M: Final = {"Left Lane Change": 3.5, "Right Lane Change": -3.5}


class ScriptedEngine:
    """`looktwice.model.engines.engine.Engine` by rule.

    Attributes:
        failure: raised at the first iteration of every request.
        failure_later: raised behind the first plans.
        start_failure: raised by `start`.
        may_start: `start` returns when it is set.
        may_begin: requests wait for it in the queue, after they were noted.
        may_finish: requests wait for it behind their first plan.
        breaks: what is put into it ends the engine.
        times_s: of the poses of its trajectories.
        cut: what deadlines do to second looks.
        starts: how often it was started.
        submitted, cancelled: what was asked, in order.
    """

    def __init__(self) -> None:
        self.failure: Exception | None = None
        self.failure_later: Exception | None = None
        self.start_failure: Exception | None = None
        self.may_start = asyncio.Event()
        self.may_start.set()
        self.may_finish = asyncio.Event()
        self.may_finish.set()
        self.may_begin = asyncio.Event()
        self.may_begin.set()
        self.breaks: asyncio.Queue[EngineError] = asyncio.Queue()
        self.times_s = TEN_HZ_S
        self.cut: Cut | None = None
        self.starts = 0
        self.submitted: list[PlanRequest] = []
        self.cancelled: list[str] = []
        self.finished = 0
        self.stopped = False
        self.card_shown = CARD

    @property
    def card(self) -> ModelCard:
        return self.card_shown

    @property
    def load(self) -> EngineLoad:
        return EngineLoad(rows=64, rows_used=len(self.submitted) - self.finished)

    async def wait(self) -> None:
        raise await self.breaks.get()

    async def start(self) -> None:
        self.starts += 1
        await self.may_start.wait()
        if self.start_failure is not None:
            raise self.start_failure

    async def stop(self) -> None:
        self.stopped = True

    async def load_weights(self, checkpoint: Path) -> None:
        self.card_shown = replace(self.card_shown, revision=read_card(checkpoint)["revision"])

    async def submit(self, request: PlanRequest) -> AsyncGenerator[Event]:
        self.submitted.append(request)
        if self.failure is not None:
            raise self.failure
        try:
            await self.may_begin.wait()
            yield Started()
            draws = [self._timed(_draw(request, index)) for index in range(request.controls.n)]
            for draw in draws:
                yield _finished(draw.index, "plan", draw.plan)
            await self.may_finish.wait()
            if self.failure_later is not None:
                raise self.failure_later
            # Later draws finish first, as they may in a batch.
            for draw in reversed(draws):
                if draw.foreseen is not None:
                    for event in _imagining(draw.index, draw.foreseen):
                        yield event
                yield _finished(draw.index, "branch", draw.branch)
                if draw.thinking is not None:
                    if request.controls.deadline_ms is not None:
                        yield DraftFinished(self._timed(_draft(request, draw)))
                    for number, word in enumerate(draw.thinking.split(" ")[:-1] if request.live else ()):
                        yield TextWritten(draw.index, "thinking", f" {word}" if number else word)
                    yield _finished(draw.index, "thinking", draw.thinking)
                    yield _finished(draw.index, "revised_plan", draw.revised_plan)
                cut = None if draw.thinking is None or request.controls.deadline_ms is None else self.cut
                yield DrawFinished(replace(draw, cut=cut))
        except (GeneratorExit, asyncio.CancelledError):
            self.cancel(request.request_id)
            raise
        finally:
            self.finished += 1

    def prompt_tokens(self, request: PlanRequest) -> int:
        return 100 - 5 * (request.scene.route is None) - 20 * (request.format == "traj_only")

    def paint(self, request: PlanRequest, codes: Sequence[int]) -> npt.NDArray[np.uint8]:
        if not self.card_shown.paints:
            raise RequestError("it paints nothing")
        grey = np.resize(np.array(codes) // 4, (7, 14)).astype(np.uint8)
        return np.kron(grey[..., None], np.ones((16, 16, 3), np.uint8))

    def cancel(self, request_id: str) -> None:
        self.cancelled.append(request_id)

    def _timed(self, draw: Draw) -> Draw:
        trajectory = at_times(draw.trajectory, TEN_HZ_S, self.times_s)
        return replace(draw, trajectory=trajectory, times_s=self.times_s)


def _finished(index: int, section: str, value: Plan | str | None) -> SectionFinished:
    """A section of one value."""
    return SectionFinished(index, section, str(value), () if value is None else (value,))


def _draw(request: PlanRequest, index: int) -> Draw:
    controls = request.controls
    luck = random.Random(1000 * controls.seed + index)
    probability = round(luck.uniform(0.05, 0.6), 4)
    think = controls.thinking == "always" or (
        controls.thinking == "adaptive"
        and (
            luck.random() < probability
            if controls.think_threshold is None
            else probability > controls.think_threshold
        )
    )
    first = controls.prefill or KEEP_ON
    followed = SLOW_DOWN if think else first
    branch = "Thinking:" if think else "Action:"
    second_look = {"thinking": 48, "revised_plan": 52} if think else {}
    tokens = {"plan": 40, "branch": 1, **second_look, "trajectory": 8}
    direct = Draw(
        index=index,
        text=f"{first}{branch}",
        plan=first,
        branch=branch,
        think_probability=probability,
        thinking=None,
        revised_plan=None,
        trajectory=_drive(followed, present_speed(request.scene.history), luck),
        codes=(1, 2, 3, 4, 5, 6),
        tokens=tokens,
        passes=30,
        chosen=20,
        ids=(11, 12, 13 + index),
        logprobs=(None, -0.25, -1.5) if controls.logprobs else (),
        section_logprobs={"visual": -400.0 - index},
        foreseen=_foreseen(controls.camera, luck) if controls.imagine == "always" else None,
    )
    return replace(direct, thinking=REASONING, revised_plan=SLOW_DOWN) if think else direct


def _foreseen(camera: str | None, luck: random.Random) -> Foreseen:
    """A car ahead, and a picture of any colours."""
    ahead = PerceivedAgent("vehicle", 20.0, 0.0, 4.5, 1.9, 2.0)
    picture = NextPicture(camera or "front", tuple(luck.randrange(1000) for _ in range(98)))
    return Foreseen(Perceived((ahead,), 1.7, 5.2), 5.0, 0.0, "Forward", picture)


def _imagining(index: int, foreseen: Foreseen) -> Iterator[Event]:
    """What is told while it is written, seven codes at a time."""
    assert foreseen.picture is not None
    ahead: Value = {"kind": "vehicle", "lateral_m": 0.0, "forward_m": 20.0, "length_m": 4.5, "width_m": 1.9}
    yield SectionFinished(index, "perception", "", ((ahead,), 1.7, 5.2))
    yield SectionFinished(index, "prediction", "", ({"lateral_m": 0.0, "forward_m": 5.0}, "Forward"))
    for count in range(7, 98, 7):
        yield CodesWritten(index, "visual", count)
    camera = f"CAM_{foreseen.picture.camera.upper()}"
    yield SectionFinished(index, "visual", "", (beside(None, foreseen.picture.codes), camera))


def _draft(request: PlanRequest, draw: Draw) -> Draw:
    """Where a draw's first plan would have led."""
    luck = random.Random(draw.index)
    trajectory = _drive(draw.plan or KEEP_ON, present_speed(request.scene.history), luck)
    return replace(draw, branch="Action:", thinking=None, revised_plan=None, trajectory=trajectory)


def _drive(plan: Plan, speed: float, luck: random.Random) -> FloatArray:
    """What a car does that follows ``plan``, with a little variation in strength and curvature."""
    zeal, bend = luck.uniform(0.6, 1.3), luck.gauss(0.0, 0.004)
    rows = np.zeros((FUTURE_STEPS, 4), np.float32)
    x = y = heading = shift = 0.0
    for tick in range(FUTURE_STEPS):
        words = {group: plan.word_at(group, tick) or "" for group in GROUPS}
        speed = max(0.0, speed + zeal * _ACCELERATION.get(words["longitudinal"], 0.0) * STEP_S)
        target = _LANE_SHIFT_M.get(words["lane"], 0.0)
        shift += (target - shift) * 0.045
        heading = 0.012 * speed * STEP_S * tick * bend * 10 + np.arctan2(target - shift, 40.0)
        x += speed * STEP_S * float(np.cos(heading))
        y += speed * STEP_S * float(np.sin(heading))
        rows[tick] = (x, y, 0.0, heading)
    return rows
