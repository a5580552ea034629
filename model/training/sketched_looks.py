"""Second looks that are learned from the prompt itself: it tells what else might be driven, and they say why.

A build's reflections are on the few plans that fail. What the second sketch of a prompt
(`looktwice.model.network.second_sketch`) changes can be told for every scene: the words of both plans follow
from both trajectories, and the reason from what is in view. So a decoder learns from all scenes to put the
change into words and to copy the second sketch behind them. The critic tells which sketches deserve that.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import torch

from looktwice.model.driving.direction import wanted_changes
from looktwice.model.driving.labeller import label_plan
from looktwice.model.driving.phrases import Facts, Statement, corrected
from looktwice.model.driving.plan import TICKS, Plan
from looktwice.model.driving.reasons import reasons_read
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.families.family import Counterfactual
from looktwice.model.network.codec import TrajectoryCodec
from looktwice.model.network.second_sketch import LOOK_GAIN, CurveSpace, Known
from looktwice.model.training.batches import stacked
from looktwice.model.training.intents import IntentDataset

Around = Literal["tracks", "read"]
"""What a planner goes by: tracks, or facts that are read from pictures."""
_BATCH: Final = 256


class SceneSecondSketch(NamedTuple):
    """What else might be driven than the sketch of one prompt.

    Attributes:
        vector: float32 [d], in the codec's space.
        facts: float32 [facts], as read from pictures; the true ones beside tracks.
        gain: by how much it is likelier to hold than the sketch, as the critic judges both.
    """

    vector: FloatArray
    facts: FloatArray
    gain: float


class SecondSketches(NamedTuple):
    """What else might be driven than the sketches of one planner, for N examples; see `SceneSecondSketch`.

    Attributes:
        vectors: float32 [mirror, route, N, d].
        facts: float32 [mirror, route, N, facts].
        gains: float32 [mirror, route, N].
    """

    vectors: FloatArray
    facts: FloatArray
    gains: FloatArray

    def find(self, index: int, *, mirror: bool, route: bool) -> SceneSecondSketch:
        """That of one example, as its prompt shows it."""
        place = int(mirror), int(route), index
        return SceneSecondSketch(self.vectors[place], self.facts[place], float(self.gains[place]))


@torch.inference_mode()
def second_sketches(
    planner: Any, data: IntentDataset, around: Around, sketches: FloatArray, space: CurveSpace
) -> SecondSketches:
    """Of all examples, plain and mirrored, without and with the route.

    Args:
        planner: an `IntentReader` with second sketches.
        data: of the examples.
        around: what the planner goes by.
        sketches: float32 [mirror, route, N, d], its own.
        space: of these vectors.
    """
    vectors, facts, gains, device = [], [], [], next(planner.parameters()).device
    for mirror in (False, True):
        for route in (False, True):
            for start in range(0, len(data), _BATCH):
                places = range(start, min(start + _BATCH, len(data)))
                batch = stacked([data.look(place, mirror=mirror, route=route) for place in places])
                motion = (batch[name].to(device) for name in ("history", "route", "has_route"))
                seen = {"tracks" if around == "tracks" else "facts": batch[around].to(device)}
                first = torch.from_numpy(sketches[int(mirror), int(route), places]).to(device)
                found = planner.second(first, space, Known(*motion, **seen))
                vectors.append(found.vectors.cpu())
                facts.append(batch["facts" if around == "tracks" else "read"])
                gains.append(found.gains.cpu())
    shape = (2, 2, len(data))
    return SecondSketches(
        torch.cat(vectors).view(*shape, -1).numpy(),
        torch.cat(facts).view(*shape, -1).numpy(),
        torch.cat(gains).view(shape).numpy(),
    )


def driven_plan(codec: TrajectoryCodec, vector: FloatArray, history: FloatArray, expert: Plan) -> Plan:
    """The plan that a trajectory [d] carries out; lanes, which it does not tell, are the expert's."""
    trajectory = codec.trajectories(history[None], vector[None])[0]
    return replace(label_plan(trajectory, history, None), lane=expert.lane)


def reasoned_look(
    codec: TrajectoryCodec,
    sketch: FloatArray,
    second: SceneSecondSketch,
    history: FloatArray,
    route: FloatArray | None,
    expert: Plan,
) -> Counterfactual | None:
    """Why a second sketch is to be driven instead of a sketch [d]; see `second_look`.

    Args:
        codec: of both.
        sketch, second: what the prompt tells.
        history: float32 [16, 4].
        route: float32 [20, 2], or None where the prompt has none.
        expert: tells lanes.
    """
    if np.isnan(second.facts).all():
        return None
    first, better = _plans(codec, sketch, second, history, expert)
    found = second_look(first, better, reasons_read(history, route, second.facts))
    return None if found is None else replace(found, judged=second.gain >= LOOK_GAIN)


def same_words(
    codec: TrajectoryCodec, sketch: FloatArray, second: SceneSecondSketch, history: FloatArray, expert: Plan
) -> bool:
    """Whether words are the same for a sketch [d] and for what else might be driven."""
    return not wanted_changes(*_plans(codec, sketch, second, history, expert))


def _plans(
    codec: TrajectoryCodec, sketch: FloatArray, second: SceneSecondSketch, history: FloatArray, expert: Plan
) -> tuple[Plan, Plan]:
    """Those that a sketch [d] and the second one carry out."""
    first, better = (driven_plan(codec, each, history, expert) for each in (sketch, second.vector))
    return first, better


def second_look(first: Plan, second: Plan, reasons: Collection[Statement]) -> Counterfactual | None:
    """A reflection that leads from the plan of a sketch to that of what else might be driven.

    Args:
        first, second: both plans.
        reasons: all statements that there is a reason for, see `looktwice.model.driving.reasons`.

    Returns:
        None where both plans say the same, or nothing in view gives a reason for another one. It is not
        judged: whether it is deserved is another question.
    """
    stops = second.word_at("longitudinal", TICKS - 1) == "Wait"
    statements = []
    for changes in wanted_changes(first, second):
        fitting = [
            each
            for each in reasons
            if each.change in changes and (each.change != "slower" or (each.correction == "stop") == stops)
        ]
        statements += sorted(fitting, key=str)[:1]
    if not statements:
        return None
    facts = Facts(tuple(statements))
    return Counterfactual(first, str(facts), corrected(first, second, facts), judged=False)
