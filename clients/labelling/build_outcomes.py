"""Outcomes in a build: which of a rollout's plans hold when followed, and which are to be corrected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from looktwice.clients.labelling.ledger import Entry, Ledger, LedgerError, Record, StageRun
from looktwice.model.driving.direction import wanted_changes
from looktwice.model.driving.outcome import OUTCOMES_VERSION, Outcome
from looktwice.model.driving.plan import parse_plan


@dataclass(frozen=True)
class Followed:
    """The model's own plans in one scene, with what came of them.

    Attributes:
        expert: of the expert's own way.
        plans: of the rollout's free draws, in their order.
    """

    expert: Outcome
    plans: tuple[Outcome, ...]

    @classmethod
    def of(cls, record: Record) -> Followed:
        """Read it from its record."""
        return cls(
            Outcome.from_json(record["expert"]), tuple(Outcome.from_json(each) for each in record["plans"])
        )


def config_of(rollout: StageRun) -> Record:
    """What decides outcomes besides the scene and how its episode was set."""
    return {"rollout": rollout.id, "rules": OUTCOMES_VERSION}


def followed_plans(ledger: Ledger, rollout: StageRun) -> Mapping[str, Followed]:
    """What is known of a rollout's plans, by the rollout's keys.

    Raises:
        LedgerError: nothing is.
    """
    found = followed_entries(ledger, rollout)
    if not found:
        raise LedgerError("no plan of that rollout was followed: run `looktwice build outcomes` first")
    return {key: Followed.of(entry.record) for key, entry in found.items()}


def followed_entries(ledger: Ledger, rollout: StageRun) -> dict[str, Entry]:
    """What is entered of a rollout's plans that were followed, by the rollout's keys; may be empty."""
    config = config_of(rollout)
    run = next((run for run in ledger.runs("outcomes") if run.config == config), None)
    return {} if run is None else {entry.record["rollout"]: entry for entry in ledger.entries(run)}


def failure_of(plan: str, entry: Entry, followed: Followed) -> Outcome | None:
    """What a free draw's plan came to where it fails (`plans_that_fail`); None where it does not."""
    free = entry.record["free"]
    failing = (draw for draw in plans_that_fail(entry, followed) if free[draw]["plan"] == plan)
    draw = next(failing, None)
    return None if draw is None else followed.plans[draw]


def plans_that_fail(entry: Entry, followed: Followed) -> tuple[int, ...]:
    """The free draws whose plans fail and have a better one: for each such plan its first draw.

    A plan of several draws fails where all of them do: if it holds in some, the plan is not the reason. Where
    the expert's own way fails as well, or its plan asks for no change, there is nothing better to say.
    """
    if not followed.expert.holds:
        return ()
    better = parse_plan(entry.record["expert_plan"])
    return tuple(
        draws[0]
        for plan, draws in _draws_of(entry).items()
        if not any(followed.plans[draw].holds for draw in draws) and wanted_changes(parse_plan(plan), better)
    )


def plans_that_hold(entry: Entry, followed: Followed) -> tuple[int, ...]:
    """The free draws whose plans hold in all their draws: for each such plan its first draw."""
    return tuple(
        draws[0] for draws in _draws_of(entry).values() if all(followed.plans[draw].holds for draw in draws)
    )


def _draws_of(entry: Entry) -> dict[str, list[int]]:
    found: dict[str, list[int]] = {}
    for draw, told in enumerate(entry.record["free"]):
        found.setdefault(told["plan"], []).append(draw)
    return found
