"""Outcomes in a build: which of a rollout's plans hold when followed, and which are to be corrected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from looktwice.clients.labelling.ledger import Entry, Ledger, LedgerError, Record, StageRun
from looktwice.model.driving.mends import MENDS_VERSION, Mend
from looktwice.model.driving.outcome import OUTCOMES_VERSION, Outcome


@dataclass(frozen=True)
class VerifiedMend:
    """The smallest mend of a plan that holds when it is followed.

    Attributes:
        mend: of its trajectory.
        plan: that the mended trajectory carries out, as text.
    """

    mend: Mend
    plan: str


@dataclass(frozen=True)
class Followed:
    """The model's own plans in one scene, with what came of them.

    Attributes:
        expert: of the expert's own way.
        plans: of the rollout's free draws, in their order.
        mends: of the same draws; None where a plan holds, or nothing that words can tell mends it.
    """

    expert: Outcome
    plans: tuple[Outcome, ...]
    mends: tuple[VerifiedMend | None, ...]

    @classmethod
    def of(cls, record: Record) -> Followed:
        """Read it from its record."""
        return cls(
            Outcome.from_json(record["expert"]),
            tuple(Outcome.from_json(each) for each in record["plans"]),
            tuple(None if told is None else VerifiedMend(**told) for told in record["mends"]),
        )


def config_of(rollout: StageRun) -> Record:
    """What decides outcomes besides the scene and how its episode was set."""
    return {"rollout": rollout.id, "rules": OUTCOMES_VERSION, "mends": MENDS_VERSION}


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


@dataclass(frozen=True)
class FailingPlan:
    """A plan that fails when it is followed: at what, and the smallest mend that holds."""

    outcome: Outcome
    better: VerifiedMend


def failure_of(plan: str, entry: Entry, followed: Followed) -> FailingPlan | None:
    """What is known of a free draw's plan where it fails (`plans_that_fail`); None where it does not."""
    free = entry.record["free"]
    for draw in plans_that_fail(entry, followed):
        better = followed.mends[draw]
        if free[draw]["plan"] == plan and better is not None:
            return FailingPlan(followed.plans[draw], better)
    return None


def plans_that_fail(entry: Entry, followed: Followed) -> tuple[int, ...]:
    """The free draws whose plans fail and can be mended: for each such plan the first draw with a mend.

    A plan of several draws fails where all of them do: if it holds in some, the plan is not the reason. Where
    the expert's own way fails as well, or words tell no mend, there is nothing better to say.
    """
    found = []
    for draws in _draws_of(entry).values():
        if not any(followed.plans[draw].holds for draw in draws):
            found += [draw for draw in draws if followed.mends[draw] is not None][:1]
    return tuple(found)


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
