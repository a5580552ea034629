"""What is made of outcomes: which plans are to be corrected, and which acted on."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from looktwice.clients.labelling.build_outcomes import (
    Followed,
    VerifiedMend,
    config_of,
    failure_of,
    followed_plans,
    plans_that_fail,
    plans_that_hold,
)
from looktwice.clients.labelling.export import held_plans
from looktwice.clients.labelling.filtering import filtered_by_outcome, summary
from looktwice.clients.labelling.ledger import Entry, Ledger, LedgerError
from looktwice.model.driving.outcome import FailureName, Outcome
from tests.clients.labelling.builds import GO_FASTER, rolled_out, rollout_record
from tests.service.scripted_engine import KEEP_ON, SLOW_DOWN


def outcome(*fails: FailureName) -> Outcome:
    return Outcome(fails, None, None, None, None, None, None, 50.0, 60.0)


def entry(*plans: object) -> Entry:
    record = rollout_record()
    (draw, *_) = record["free"]
    record["free"] = [draw | {"plan": str(plan)} for plan in plans]
    return Entry("key", "scene", "done", record, "2026-01-01T00:00:00.000Z")


HOLDS, FAILS = outcome(), outcome("behind")
MEND = VerifiedMend("ease off", str(SLOW_DOWN))


@pytest.mark.parametrize(
    ("expert", "plans", "outcomes", "mends", "fail", "hold"),
    [
        (HOLDS, (KEEP_ON, GO_FASTER), (FAILS, HOLDS), (MEND, None), (0,), (1,)),
        (HOLDS, (KEEP_ON, KEEP_ON), (FAILS, FAILS), (MEND, MEND), (0,), ()),
        (HOLDS, (KEEP_ON, KEEP_ON), (FAILS, FAILS), (None, MEND), (1,), ()),
        (HOLDS, (KEEP_ON, KEEP_ON), (HOLDS, FAILS), (None, MEND), (), ()),
        (HOLDS, (GO_FASTER, KEEP_ON, KEEP_ON), (FAILS, HOLDS, HOLDS), (MEND, None, None), (0,), (1,)),
        (HOLDS, (SLOW_DOWN, KEEP_ON), (FAILS, FAILS), (None, MEND), (1,), ()),
        (FAILS, (KEEP_ON, GO_FASTER), (FAILS, HOLDS), (None, None), (), (1,)),
    ],
    ids=["one each", "twice wrong", "mended once", "now and then", "twice right", "no words", "nobody can"],
)
def test_which_plans_fail_and_which_hold(
    expert: Outcome, plans: Any, outcomes: Any, mends: Any, fail: tuple[int, ...], hold: tuple[int, ...]
) -> None:
    found, followed = entry(*plans), Followed(expert, outcomes, mends)
    assert plans_that_fail(found, followed) == fail
    assert plans_that_hold(found, followed) == hold


def test_a_plan_that_fails_is_told_with_its_mend() -> None:
    found = entry(KEEP_ON, KEEP_ON, GO_FASTER)
    followed = Followed(HOLDS, (FAILS, outcome("collision"), HOLDS), (None, MEND, None))
    failing = failure_of(str(KEEP_ON), found, followed)
    assert failing is not None
    assert (failing.outcome.fails, failing.better) == (("collision",), MEND)
    assert failure_of(str(GO_FASTER), found, followed) is None


def test_the_filter_keeps_failing_plans_and_the_export_adds_those_that_hold(tmp_path: Path) -> None:
    rollout = rolled_out(tmp_path, 3)
    with Ledger(tmp_path) as ledger:
        labels = ledger.run("label", {"rollout": rollout.id, "teacher": "t", "revision": "1"})
        with pytest.raises(LedgerError, match="looktwice build outcomes"):
            followed_plans(ledger, rollout)
        with pytest.raises(LedgerError, match="looktwice build outcomes"):
            list(held_plans(ledger, labels))
        first, second, _ = ledger.entries(rollout)
        run = ledger.run("outcomes", config_of(rollout))
        for one, plans in ((first, (FAILS, HOLDS)), (second, (HOLDS, HOLDS))):
            record = {
                "rollout": one.key,
                "expert": HOLDS.to_json(),
                "plans": [plan.to_json() for plan in plans],
                "mends": [None if plan.holds else asdict(MEND) for plan in plans],
            }
            ledger.finish(run, f"o-{one.key}", one.scene_id, record)
        followed = followed_plans(ledger, rollout)
        found = filtered_by_outcome(ledger.entries(rollout), followed)
        assert [scene.draws for scene in found] == [(0,), ()], "the third was not followed"
        told = summary(found)
        assert (told["scenes"], told["kept"], told["plans"]) == (2, 1, 1)
        held = list(held_plans(ledger, labels))
        assert [(each.scene_id, each.predicted_plan) for each in held] == [
            (first.scene_id, GO_FASTER),
            (second.scene_id, KEEP_ON),
            (second.scene_id, GO_FASTER),
        ]
        assert {each.reflection for each in held} == {""}


def test_another_rule_s_outcomes_are_not_taken_for_these(tmp_path: Path) -> None:
    rollout = rolled_out(tmp_path, 1)
    with Ledger(tmp_path) as ledger:
        (one,) = ledger.entries(rollout)
        older = ledger.run("outcomes", {**config_of(rollout), "rules": 0})
        ledger.finish(older, "o", one.scene_id, {"rollout": one.key, "expert": {}, "plans": [], "mends": []})
        with pytest.raises(LedgerError, match="looktwice build outcomes"):
            followed_plans(ledger, rollout)
