"""From the engine's draws to the wire's answers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, get_args

import numpy as np

import looktwice.clients.wire as wire
from looktwice.clients.wire_values import wire_plan
from looktwice.model.driving.agreement import Agreement
from looktwice.model.driving.plan import Plan, plan_changes, plan_iou
from looktwice.model.driving.trajectory import TEN_HZ_S, agreed
from looktwice.model.engines.engine import Draw
from looktwice.model.families.registry import family_named
from looktwice.model.formats.pieces import Plain
from looktwice.model.network.model_card import ModelCard
from looktwice.service.planning.events import PlannedScene
from looktwice.service.problems import REFUSED, ProblemError

_DECIMALS: Final = 4
"""Of poses on the wire: a tenth of a millimetre."""


def plan_answer(planned: PlannedScene, request_id: str) -> wire.PlanResponse:
    """The answer of POST /v1/plan."""
    return wire.PlanResponse(
        request_id=request_id,
        model=_model(planned.card),
        draws=[
            _draw(draw, planned.agreements[draw.index], planned.drafts.get(draw.index))
            for draw in planned.draws
        ],
        agreed=agreed(np.stack([draw.trajectory for draw in planned.draws])),
        timing=planned.timing,
        deadline=planned.deadline,
    )


def reflect_answer(planned: PlannedScene, request_id: str) -> wire.ReflectResponse:
    """The answer of POST /v1/reflect; raises `ProblemError` where the format has no plan."""
    first = planned.draws[0]
    if first.plan is None or first.think_probability is None:
        raise ProblemError(REFUSED, "responses in this format hold no plan to reflect upon")
    return wire.ReflectResponse(
        request_id=request_id,
        model=_model(planned.card),
        plan=wire_plan(first.plan),
        think_probability=first.think_probability,
        draws=[_reflection(first.plan, draw, planned.agreements[draw.index]) for draw in planned.draws],
        timing=planned.timing,
        deadline=planned.deadline,
    )


def model_card(card: ModelCard) -> wire.ModelCard:
    """A model card for the wire."""
    return wire.ModelCard(
        name=card.name,
        revision=card.revision,
        engine=card.engine,
        formats=list(card.formats),
        reflects=[name for name in card.formats if family_named(name).looks_twice],
        refines=[name for name in card.formats if family_named(name).refines],
        imagines=[name for name in card.formats if family_named(name).imagination is not None],
        paints=card.paints,
        thinking={name: list(family_named(name).thinking_choices) for name in card.formats},
        deadlines=card.deadlines,
        cameras=list(card.cameras),
        image_size=list(card.image_size),
        parameters=card.parameters,
        inputs=list(card.inputs),
        details=dict(card.details),
    )


def wire_branch(*, looked_twice: bool) -> wire.Branch:
    """The wire's word for the option that was taken, whatever a family calls it."""
    direct, reflecting = get_args(wire.Branch)
    taken: wire.Branch = reflecting if looked_twice else direct
    return taken


def wire_trajectory(draw: Draw) -> list[list[float]]:
    """A draw's trajectory for the wire."""
    rows: list[list[float]] = draw.trajectory.astype(float).round(_DECIMALS).tolist()
    return rows


def wire_sections(sections: Mapping[str, list[Plain]]) -> list[wire.Section]:
    """What a format's own sections say, for the wire."""
    told = [{"name": name, "values": values} for name, values in sections.items()]
    return [wire.Section.model_validate(each) for each in told]


def wire_times(draw: Draw) -> list[float] | None:
    """When its poses are, where that is not at 10 Hz."""
    return None if draw.times_s == TEN_HZ_S else list(draw.times_s)


def _model(card: ModelCard) -> wire.ModelName:
    return wire.ModelName(name=card.name, revision=card.revision)


def _draw(draw: Draw, agreement: Agreement, draft: Draw | None) -> wire.Draw:
    return wire.Draw(
        index=draw.index,
        plan=None if draw.plan is None else wire_plan(draw.plan),
        branch=None if draw.branch is None else wire_branch(looked_twice=draw.looked_twice),
        think_probability=draw.think_probability,
        thinking=draw.thinking,
        revised_plan=None if draw.revised_plan is None else wire_plan(draw.revised_plan),
        trajectory=wire_trajectory(draw),
        times_s=wire_times(draw),
        draft_trajectory=None if draft is None or not draw.looked_twice else wire_trajectory(draft),
        cut=draw.cut,
        consistent=agreement.consistent,
        disagreements=list(agreement.disagreements),
        reasons=None if draw.reasons is None else list(draw.reasons),
        sections=wire_sections(draw.sections),
        tokens=dict(draw.tokens),
        logprobs=_logprobs(draw),
    )


def _logprobs(draw: Draw) -> wire.Logprobs | None:
    """Where they were asked for; below 0 by rounding alone where a token is certain."""
    if not draw.logprobs:
        return None
    return wire.Logprobs(token_ids=list(draw.ids), logprobs=list(draw.logprobs))


def _reflection(given: Plan, draw: Draw, agreement: Agreement) -> wire.Reflection:
    revised = draw.revised_plan or given
    changes = [
        wire.PlanChange(
            group=change.group,
            start_s=change.start / 10,
            end_s=change.end / 10,
            proposed=change.before,
            revised=change.after,
        )
        for change in plan_changes(given, revised)
    ]
    return wire.Reflection(
        index=draw.index,
        decision="revise" if changes else "keep",
        thinking=draw.thinking,
        revised_plan=None if draw.revised_plan is None else wire_plan(draw.revised_plan),
        plan_iou=plan_iou(given, revised),
        changes=changes,
        trajectory=wire_trajectory(draw),
        times_s=wire_times(draw),
        cut=draw.cut,
        consistent=agreement.consistent,
        disagreements=list(agreement.disagreements),
        reasons=None if draw.reasons is None else list(draw.reasons),
        tokens=dict(draw.tokens),
        logprobs=_logprobs(draw),
    )
