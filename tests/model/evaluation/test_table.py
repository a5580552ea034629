from __future__ import annotations

import json

import pytest

from looktwice.model.driving.labeller import expert_plan
from looktwice.model.evaluation.bootstrap import compare
from looktwice.model.evaluation.open_loop import MEASURES, evaluate_baselines, evaluate_draws
from looktwice.model.evaluation.table import VariantRow, format_table, to_json
from tests.model.driving.drives import labelled_scene
from tests.model.evaluation.fakes import draw_of, offset

SCENES = [labelled_scene(10.0, 0.02 * i, scene_id=f"s{i}", episode_id=f"e{i // 2}") for i in range(6)]
RESULTS = [
    evaluate_draws(
        scene,
        [draw_of(offset(scene.future, 0.5 * k), expert_plan(scene), index=k, tokens=80) for k in range(3)],
    )
    for scene in SCENES
]
ROW = VariantRow.of("meta-act", RESULTS, MEASURES, thinking="adaptive", n=3, route=True)
BASELINE = evaluate_baselines(SCENES)["constant velocity"]

CONTRACT = {
    "name",
    "thinking",
    "agreed_ade_m",
    "greedy_ade_m",
    "min_ade_m",
    "avg_ade_m",
    "min_fde_m",
    "avg_fde_m",
    "corner_distance_m",
    "collision_rate",
    "off_road_rate",
    "agreement_plan_trajectory",
    "agreement_reason_change",
    "agreement_reason_view",
    "plan_iou_first",
    "plan_iou_revised",
    "output_tokens",
    "think_rate",
    "n",
    "route",
    "scenes",
    "episodes",
    "intervals",
}


def test_json_has_the_keys_that_scripts_rely_on() -> None:
    comparison = compare("meta-act : constant velocity", RESULTS, BASELINE)
    report = json.loads(json.dumps(to_json([ROW, VariantRow.of("cv", BASELINE, MEASURES)], [comparison])))
    assert (report["scenes"], report["episodes"]) == (6, 3)
    row, baseline = report["rows"]
    assert set(row) >= CONTRACT
    assert set(baseline) >= CONTRACT
    assert (row["name"], row["thinking"], row["n"], row["route"]) == ("meta-act", "adaptive", 3, True)
    assert row["avg_ade_m"] == pytest.approx(0.5, abs=1e-5)
    assert row["plan_iou_first"] == 1.0
    assert row["output_tokens"] == 80
    assert row["intervals"]["avg_ade_m"] == pytest.approx([0.5, 0.5], abs=1e-5)
    assert baseline["thinking"] is None
    assert baseline["plan_iou_first"] is None
    assert "plan_iou_first" not in baseline["intervals"]
    assert report["comparisons"][0]["ratio"] == comparison.ratio


def test_the_text_shows_every_row_in_aligned_columns() -> None:
    some = VariantRow.of(
        "meta-act", RESULTS[:2], MEASURES, thinking="never", n=3, subgroup="lead within 20 m"
    )
    text = format_table(
        [VariantRow.of("constant velocity", BASELINE, MEASURES), ROW, some],
        [compare("gain", RESULTS, BASELINE)],
    )
    header, *rows = text.splitlines()
    assert [row.split("  ")[0] for row in rows] == [
        "constant velocity",
        "meta-act",
        "meta-act [lead within 20 m]",
        "gain",
    ]
    end = header.index("minADE m") + len("minADE m")
    column = [row[:end].split()[-1] for row in rows[:3]]
    assert column == [
        f"{row.values['min_ade_m']:.2f}" for row in (VariantRow.of("", BASELINE, MEASURES), ROW, some)
    ]
    assert rows[0].endswith("-")
    assert "ratio" in rows[3]


def test_an_empty_table_is_an_empty_report_and_a_row_needs_scenes() -> None:
    assert to_json([])["rows"] == []
    with pytest.raises(ValueError, match="row 'x' has no scenes"):
        VariantRow.of("x", [], MEASURES)
