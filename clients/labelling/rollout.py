"""Rollout: what a served model does in a scene, alone and with the expert's plan (CF-VLA section 3.3)."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from looktwice.clients import wire
from looktwice.clients.answers import (
    BadAnswer,
    PlannerError,
    PlannerProblem,
    PlannerUnreachable,
    PlanResult,
    RequestRefused,
    ServiceBusy,
)
from looktwice.clients.labelling.ledger import Record, StageRun
from looktwice.clients.labelling.pipeline import CannotBeDone, Job, StageStopped
from looktwice.clients.planner import AsyncPlannerClient, RetryPolicy
from looktwice.clients.retries import TryLater, with_retries
from looktwice.model.driving.hashing import hash_of, scene_hash
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.metrics import displacement_errors
from looktwice.model.driving.plan import Plan, plan_iou
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.trajectory import FUTURE_STEPS, FloatArray

RETRY_POLICY = RetryPolicy(timeout_s=120.0, attempts=1)
"""Who waits how long is the pipeline's to say."""
_PACKED: Final = np.dtype("<f4")


@dataclass(frozen=True)
class Sampling:
    """How responses are drawn; a part of every key.

    Nobody thinks: what is judged are first plans, and the trajectories that they lead to.

    Attributes:
        n: draws, both freely and with the expert's plan.
        temperature, top_p, seed: as in `wire.Controls`.
        route: whether the model is told the route.
        tracks: whether it is told the tracks of the agents around.
    """

    n: int = 6
    temperature: float = 1.0
    top_p: float = 1.0
    seed: int = 0
    route: bool = True
    tracks: bool = False

    @property
    def controls(self) -> wire.Controls:
        """As the service takes them."""
        return wire.Controls(
            n=self.n, thinking="never", temperature=self.temperature, top_p=self.top_p, seed=self.seed
        )


def config_of(model: wire.ModelName, sampling: Sampling) -> Record:
    """What decides a rollout besides the scene."""
    thinking = sampling.controls.thinking
    return {"model": model.name, "revision": model.revision, "thinking": thinking, **asdict(sampling)}


def key_of(run: StageRun, labelled: LabelledScene) -> str:
    """What the outcome of a run in a scene with its expert is found by."""
    return hash_of(run.id, scene_hash(labelled.scene), labelled.future.tobytes())


def jobs(
    run: StageRun, scenes: Path, unlabelled: Callable[[str], None], group: int | None = None
) -> Iterator[Job[LabelledScene]]:
    """The scenes of a file or folder as pieces of work; ``unlabelled`` is told of those without a future."""
    for labelled in read_scenes(scenes, dense=False, unlabelled=unlabelled, group=group):
        yield Job(key_of(run, labelled), labelled.scene.scene_id, labelled)


async def roll_out(
    planner: AsyncPlannerClient, labelled: LabelledScene, model: wire.ModelName, sampling: Sampling
) -> Record:
    """The record of one scene.

    Raises:
        TryLater: the service is busy or away.
        CannotBeDone: it refuses the scene.
        StageStopped: another model answers than before.
    """
    expert = expert_plan(labelled)
    scene = labelled.given(route=sampling.route, tracks=sampling.tracks)
    with of_the_service():
        free = await planner.plan(scene, sampling.controls)
        given = await planner.plan(scene, sampling.controls, prefill=expert)
    for answer in (free, given):
        if answer.model != model:
            raise StageStopped(
                f"the service now runs {answer.model.name} {answer.model.revision} instead of "
                f"{model.revision}; run again to roll that one out"
            )
    return {
        "tags": sorted(labelled.tags),
        "expert_plan": str(expert),
        "free": _draws(free, labelled, expert),
        "prefilled": _draws(given, labelled, None),
    }


async def served_model(planner: AsyncPlannerClient, give_up_after_s: float) -> wire.ModelName:
    """The model that a service runs, which may still be loading.

    Raises:
        StageStopped: nobody answers, or the service is not ready after so many seconds.
    """

    async def ask() -> list[wire.ModelCard]:
        try:
            return await planner.models()
        except ServiceBusy as error:
            raise TryLater(str(error), error.retry_after_s) from error

    try:
        (card, *_) = await with_retries(ask, give_up_after_s)
    except (TryLater, PlannerError) as error:
        raise StageStopped(f"no service answers at {planner.base_url}: {error}") from error
    return wire.ModelName(name=card.name, revision=card.revision)


@contextmanager
def of_the_service() -> Iterator[None]:
    """What a planning service may do wrong, as a stage takes it.

    Raises:
        TryLater: it is busy or away.
        CannotBeDone: it refuses, or fails at, what it was asked.
    """
    try:
        yield
    except ServiceBusy as error:
        raise TryLater(str(error), error.retry_after_s) from error
    except PlannerUnreachable as error:
        raise TryLater(str(error)) from error
    except RequestRefused as error:
        raise CannotBeDone(error.detail, type=error.type) from error
    except PlannerProblem as error:
        raise CannotBeDone(str(error), type=error.type) from error
    except BadAnswer as error:
        raise CannotBeDone(str(error)) from error


def _draws(result: PlanResult, labelled: LabelledScene, expert: Plan | None) -> list[dict[str, Any]]:
    told = []
    for draw in result.draws:
        errors = displacement_errors(draw.trajectory[None], labelled.future)
        row: dict[str, Any] = {"ade_m": round(errors.min_ade_m, 4), "tokens": sum(draw.tokens.values())}
        if expert is not None and draw.plan is not None:
            row |= {
                "plan": str(draw.plan),
                "plan_iou": round(plan_iou(draw.plan, expert), 4),
                "think_probability": draw.think_probability,
                "trajectory": packed(draw.trajectory),
            }
        told.append(row)
    return told


def packed(trajectory: FloatArray) -> str:
    """A trajectory [64, 4] as a record keeps it, to the last bit: float32, little-endian, in base64."""
    return base64.b64encode(np.ascontiguousarray(trajectory, _PACKED).tobytes()).decode()


def unpacked(text: str) -> FloatArray:
    """The trajectory [64, 4] that `packed` made text of."""
    values = np.frombuffer(base64.b64decode(text, validate=True), _PACKED)
    return values.reshape(FUTURE_STEPS, 4).astype(np.float32)


def min_ade_m(draws: Sequence[Mapping[str, Any]]) -> float:
    """The smallest average displacement error of some draws."""
    return float(np.min([draw["ade_m"] for draw in draws]))
