"""What happens to a plan's draws, in the wire's words."""

from __future__ import annotations

import looktwice.clients.wire as wire
from looktwice.clients.wire_values import wire_plan
from looktwice.model.driving.plan import Plan
from looktwice.model.engines.engine import DraftFinished, SectionFinished, TextWritten
from looktwice.model.families.family import Family
from looktwice.model.families.registry import family_named
from looktwice.model.formats.pieces import Values
from looktwice.service.planning.events import Judged, SceneEvent
from looktwice.service.planning.wire_answers import wire_branch, wire_sections, wire_times, wire_trajectory

Written = (
    wire.PlanWritten | wire.BranchTaken | wire.ThinkingWritten | wire.SectionWritten | wire.TrajectoryWritten
)
"""The data of an event."""


class PlanTeller:
    """Tells of the draws of one scene, by the kind of what they say.

    That is a plan, an option, words, a trajectory, or a section that only their format has.

    Args:
        format: that the response is in.
    """

    def __init__(self, format: str) -> None:
        self._family: Family = family_named(format)
        self._told: dict[int, str] = {}

    async def __call__(self, event: SceneEvent) -> list[tuple[str, Written]]:
        """Events of `looktwice.clients.wire.EVENTS` with their data."""
        family = self._family
        match event:
            case TextWritten(index, section, text) if section == family.reflection:
                # Words that are made of values are told when these are there.
                return [] if family.reflection_text is not None else self._words(index, text)
            case SectionFinished(index, section, _, values) if section == family.reflection:
                words = family.reflected(Values({section: values})) or ""
                return self._words(index, words.removeprefix(self._told.get(index, "")))
            case SectionFinished(index, section, _, values) if (
                family.branch is not None and section == family.branch.name
            ):
                branch = wire_branch(looked_twice=family.branch.reflecting in values)
                return [("branch", wire.BranchTaken(index=index, branch=branch))]
            case SectionFinished(index, section, _, (Plan() as plan, *_)) if section in family.plans:
                name = "plan" if section == family.first_plan else "revised_plan"
                return [(name, wire.PlanWritten(index=index, plan=wire_plan(plan)))]
            case SectionFinished(index, section, _, (_, *_) as values) if section in family.own_sections:
                [told] = wire_sections(family.own(Values({section: values})))
                return [("section", wire.SectionWritten(index=index, section=told))]
            case DraftFinished(draw):
                trajectory = wire.TrajectoryWritten(
                    index=draw.index, trajectory=wire_trajectory(draw), times_s=wire_times(draw)
                )
                return [("draft_trajectory", trajectory)]
            case Judged(draw, agreement):
                trajectory = wire.TrajectoryWritten(
                    index=draw.index,
                    trajectory=wire_trajectory(draw),
                    times_s=wire_times(draw),
                    consistent=agreement.consistent,
                    disagreements=list(agreement.disagreements),
                )
                return [("trajectory", trajectory)]
        return []

    def finished(self, draw: wire.Draw) -> list[tuple[str, Written]]:
        """The events of a whole draw, in the order of its response."""
        family, index = self._family, draw.index
        told: dict[str | None, tuple[str, Written]] = {
            section.name: ("section", wire.SectionWritten(index=index, section=section))
            for section in draw.sections
        }
        if family.branch is not None and draw.branch is not None:
            told[family.branch.name] = ("branch", wire.BranchTaken(index=index, branch=draw.branch))
        if draw.thinking:
            told[family.reflection] = ("thinking", wire.ThinkingWritten(index=index, text=draw.thinking))
        if draw.plan is not None:
            told[family.first_plan] = ("plan", wire.PlanWritten(index=index, plan=draw.plan))
        if draw.revised_plan is not None:
            revised = wire.PlanWritten(index=index, plan=draw.revised_plan)
            told[family.revised_plan] = ("revised_plan", revised)
        trajectory = wire.TrajectoryWritten(
            index=index,
            trajectory=draw.trajectory,
            times_s=draw.times_s,
            consistent=draw.consistent,
            disagreements=draw.disagreements,
        )
        return [*(told[section] for section in draw.tokens if section in told), ("trajectory", trajectory)]

    def _words(self, index: int, text: str) -> list[tuple[str, Written]]:
        if not text:
            return []
        self._told[index] = self._told.get(index, "") + text
        return [("thinking", wire.ThinkingWritten(index=index, text=text))]
