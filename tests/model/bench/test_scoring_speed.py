"""The scorer's bench without NAVSIM."""

from __future__ import annotations

from looktwice.model.bench.scoring_speed import measure, scene
from looktwice.model.driving.pdm.scoring import Others, score


def test_without_a_checkout_there_is_nothing_to_compare_with() -> None:
    told = measure(1, [], None).to_json()
    assert told.keys() == {"seconds_6", "seconds_4096", "navsim_seconds_a_plan", "times_navsim"}
    assert told["times_navsim"] is None
    assert told["seconds_4096"]


def test_its_plans_are_good_and_bad() -> None:
    world, plans = scene(200)
    values = score(world, plans, "v2.2", Others(reference=plans[0])).partial_score
    assert (values == 0).mean() > 0.1
    assert (values > 0.5).mean() > 0.1
