from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from looktwice.model.driving.images import decode_image
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.plan import parse_plan
from looktwice.model.engines.engine import Controls
from looktwice.model.evaluation.ladder import (
    COUNTERFACTUAL,
    LADDER,
    META_ACT,
    ROUND_2,
    TEMPERATURES,
    THRESHOLDS,
    WHOLE_DATASET,
    at_threshold,
    by_difficulty,
    hard_to_easy,
    ladder_report,
    ladder_variants,
    temperature_variants,
    threshold_results,
    threshold_variants,
)
from looktwice.model.evaluation.ladder_plots import difficulty_plot, temperature_plot, threshold_plot
from looktwice.model.evaluation.open_loop import SceneResult, evaluate_draws
from looktwice.model.evaluation.variants import Variant
from tests.model.driving.drives import labelled_scene
from tests.model.evaluation.fakes import draw_of


def result(scene: int, error_m: float, think_rate: float | None = None, **more: float) -> SceneResult:
    errors = dict.fromkeys(
        ("agreed_ade_m", "avg_ade_m", "min_ade_m", "min_fde_m", "avg_fde_m", "corner_distance_m"), error_m
    )
    rates = {"collision_rate": 0.1, "off_road_rate": 0.1, "path_m": 50.0, "path_error_m": 0.0}
    plans = {"plan_iou_first": 0.5, "plan_iou_revised": 0.6, "output_tokens": 60.0, "think_rate": think_rate}
    measures: dict[str, Any] = errors | rates | plans | more
    about: dict[str, Any] = {"scene_id": f"s{scene}", "episode_id": f"e{scene // 4}", "tags": frozenset()}
    return SceneResult(**about, lead_close=False, lead_soon=False, **measures)


def test_a_rung_has_its_rows_with_and_without_the_route() -> None:
    names = {
        entry: [each.name for each in ladder_variants(entry, Controls(n=6), route=True)] for entry in LADDER
    }
    assert names[META_ACT] == [
        "traj-only + route",
        "meta-act + route",
        "meta-act, expert plan + route",
    ]
    asked = [
        each.controls for each in ladder_variants(COUNTERFACTUAL, Controls(think_threshold=0.3), route=False)
    ]
    assert [(each.thinking, each.think_threshold) for each in asked] == [
        ("adaptive", 0.3),
        ("never", None),
        ("always", None),
    ]
    everything = [name for of in names.values() for name in of]
    assert len(set(everything)) == len(everything)
    assert len(temperature_variants(COUNTERFACTUAL, Controls(n=6))) == len(TEMPERATURES)


def test_difficulty_is_told_by_the_error_without_thinking() -> None:
    never = [result(scene, float(scene)) for scene in range(40)]
    adaptive = [result(scene, 40.0 - scene, scene / 40) for scene in reversed(range(40))]
    ten = by_difficulty(adaptive, never)
    assert hard_to_easy(ten) == pytest.approx(35.5 / 3.5)
    groups = by_difficulty(adaptive, never, 5)
    assert [group.scenes for group in groups] == [8] * 5
    assert [group.never_m for group in groups] == sorted(group.never_m for group in groups)
    assert groups[-1].think_rate == pytest.approx(np.mean(np.arange(32, 40) / 40))
    assert groups[0].adaptive_m > groups[-1].adaptive_m


def test_the_ladder_compares_what_the_paper_compares() -> None:
    results = {
        each: [result(scene, 2.0, 0.2) for scene in range(40)]
        for entry in (META_ACT, COUNTERFACTUAL)
        for each in ladder_variants(entry, Controls(n=6), route=False)
    }
    for variant, of in results.items():
        factor = {"counterfactual, adaptive": 0.9, "traj-only": 1.2}.get(variant.name, 1.0)
        results[variant] = [
            replace(each, min_ade_m=each.min_ade_m * factor, thought_iou_first=0.5, thought_iou_revised=0.7)
            for each in of
        ]
    report = ladder_report(results)
    ratios = {each.name: each.ratio for each in report.report.comparisons if each.measure == "min_ade_m"}
    assert ratios["counterfactual, adaptive : meta-act"] == pytest.approx(0.9)
    assert ratios["meta-act : traj-only"] == pytest.approx(1 / 1.2)
    assert not any("round-2" in name for name in ratios), "what is not there is left out"
    (revised,) = [each for each in report.report.comparisons if "where it thinks" in each.name]
    assert revised.value == pytest.approx(0.7)
    assert revised.against == pytest.approx(0.5)
    told = report.to_json()
    assert {"rows", "comparisons", "difficulty", "scenes"} <= set(told)
    assert len(told["difficulty"]["counterfactual, adaptive"]) == 10
    assert "from easy to hard" in str(report)


def test_what_thinking_brings_is_told_of_the_same_checkpoint() -> None:
    """Not only of its best draw: also of the mean one, and of how many meet somebody."""
    factors = {"min_ade_m": 0.9, "avg_ade_m": 1.1, "collision_rate": 0.5}
    results = {
        variant: [result(scene, 2.0, 0.2) for scene in range(40)]
        for entry in (COUNTERFACTUAL, ROUND_2, WHOLE_DATASET)
        for route in (False, True)
        for variant in ladder_variants(entry, Controls(n=6), route=route)
    }
    for variant, of in results.items():
        if "adaptive" in variant.name:
            changed = [{name: getattr(each, name) * by for name, by in factors.items()} for each in of]
            results[variant] = [replace(each, **new) for each, new in zip(of, changed, strict=True)]
    report = ladder_report(results)
    told, lines = report.to_json()["comparisons"], str(report).splitlines()
    for entry in (COUNTERFACTUAL, ROUND_2, WHOLE_DATASET):
        for route in ("", " + route"):
            name = f"{entry}, adaptive{route} : {entry}, never thinks{route}"
            ratios = {each["measure"]: each["ratio"] for each in told if each["name"] == name}
            assert ratios == pytest.approx(factors)
            shown = [line.removeprefix(name).split()[0] for line in lines if line.startswith(f"{name} ")]
            assert shown == list(factors)


def test_revised_plans_are_measured_where_there_are_some() -> None:
    labelled = labelled_scene()
    right, wrong = expert_plan(labelled), parse_plan("- longitudinal\n  - 0.0s-6.4s: Wait\n")
    thought = draw_of(labelled.future, wrong, right)
    direct = draw_of(labelled.future, right)
    both = evaluate_draws(labelled, [thought, direct])
    assert (both.thought_iou_first, both.thought_iou_revised) == (0.0, 1.0)
    assert evaluate_draws(labelled, [direct]).thought_iou_first is None


def test_thresholds_choose_between_the_two_ways() -> None:
    labelled = labelled_scene()
    right, wrong = expert_plan(labelled), parse_plan("- longitudinal\n  - 0.0s-6.4s: Wait\n")
    sure, unsure = (replace(draw_of(labelled.future, wrong), think_probability=p) for p in (0.05, 0.35))
    never, always = [sure, unsure], [draw_of(labelled.future, wrong, right)] * 2
    assert at_threshold(never, always, 0.35) == never, "it must exceed the threshold"
    assert at_threshold(never, always, 0.1) == [sure, always[1]]
    name = labelled.scene.scene_id
    draws = {(f"round-2, {way} thinks", name): of for way, of in (("never", never), ("always", always))}
    found = threshold_results("round-2", threshold_variants("round-2", Controls(n=2)), [labelled], draws)
    assert [variant.controls.think_threshold for variant in found] == list(THRESHOLDS)
    rates = [result.think_rate for [result] in found.values()]
    assert rates == [0.5 * (value < 0.35) + 0.5 * (value < 0.05) for value in THRESHOLDS]
    [routed, *_] = ladder_variants("round-2", Controls(think_threshold=0.1), route=True)
    draws = {(f"{row} + route", name): of for (row, name), of in draws.items()}
    assert [of.think_rate for of in threshold_results("round-2", [routed], [labelled], draws)[routed]] == [
        0.5
    ]


def test_the_pictures_show_what_is_measured(tmp_path: Path) -> None:
    never = [result(scene, float(scene)) for scene in range(40)]
    adaptive = [result(scene, float(scene), scene / 40) for scene in range(40)]
    difficulty_plot(by_difficulty(adaptive, never), tmp_path / "difficulty.png")
    variants = temperature_variants(COUNTERFACTUAL, Controls(n=6))
    variants += [Variant(f"{COUNTERFACTUAL}, threshold {value:g}", "cf_vla") for value in THRESHOLDS]
    rows = ladder_report({each: adaptive for each in variants}).report.rows
    by_name = {row.name: row for row in rows}
    temperature_plot(
        [(value, by_name[f"{COUNTERFACTUAL}, temperature {value:g}"]) for value in TEMPERATURES],
        tmp_path / "temperature.png",
    )
    threshold_plot(
        [(value, by_name[f"{COUNTERFACTUAL}, threshold {value:g}"]) for value in THRESHOLDS],
        tmp_path / "threshold.png",
    )
    for name in ("difficulty", "temperature", "threshold"):
        assert decode_image((tmp_path / f"{name}.png").read_bytes()).std() > 10
