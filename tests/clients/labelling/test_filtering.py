from __future__ import annotations

from pathlib import Path

from looktwice.clients.labelling.filtering import Thresholds, filtered, summary
from looktwice.clients.labelling.ledger import Entry
from looktwice.clients.labelling.scatter import scatter
from looktwice.model.driving.images import decode_image
from tests.clients.labelling.builds import rollout_record


def entry(free_m: float, prefilled_m: float, *tags: str) -> Entry:
    return Entry("key", "scene", "done", rollout_record(free_m, prefilled_m, tags), "now")


def kept(thresholds: Thresholds, *pairs: tuple[float, float]) -> list[bool]:
    return [scene.selected for scene in filtered([entry(*pair) for pair in pairs], thresholds)]


def test_kept_is_what_an_expert_s_plan_would_have_mended() -> None:
    pairs = [(2.0, 0.5), (0.5, 0.1), (0.51, 0.1), (2.0, 2.0), (2.0, 3.0)]
    assert kept(Thresholds(), *pairs) == [True, False, True, False, False]
    assert kept(Thresholds(epsilon_m=1.0), *pairs) == [True, False, False, False, False]
    assert kept(Thresholds(gain_m=1.6), *pairs) == [False] * 5
    assert kept(Thresholds(everything=True), *pairs) == [True] * 5


def test_plans_can_be_kept_one_by_one() -> None:
    one = entry(0.2, 0.1)
    free = one.record["free"]
    free[0] |= {"plan_iou": 0.9}
    free[1] |= {"plan_iou": 0.3}  # and an error of 1.2 m
    (scene,) = filtered([one], Thresholds(plan_iou=0.45))
    assert scene.draws == (1,), "the other draw is right, and the scene itself is mastered"
    assert filtered([one], Thresholds())[0].draws == ()
    assert filtered([one], Thresholds(plan_iou=0.45, gain_m=1.2))[0].draws == ()
    assert filtered([one], Thresholds(everything=True))[0].draws == (0, 1)
    assert summary([scene])["plans"] == 1


def test_the_expert_s_own_plan_is_never_to_be_corrected() -> None:
    one = entry(2.0, 0.5)
    one.record["free"][0] |= {"plan_iou": 1.0}
    for thresholds in (Thresholds(), Thresholds(everything=True), Thresholds(plan_iou=1.1)):
        assert filtered([one], thresholds)[0].draws == (1,)


def test_the_same_plan_twice_is_kept_once() -> None:
    one = entry(2.0, 0.5)
    one.record["free"].append(one.record["free"][0])
    (scene,) = filtered([one], Thresholds())
    assert scene.draws == (0, 1)


def test_the_smallest_error_of_the_draws_counts() -> None:
    (scene,) = filtered([entry(2.0, 0.5)], Thresholds())
    assert (scene.free_m, scene.prefilled_m, scene.plan_iou) == (2.0, 0.5, 0.5)


def test_scenes_are_counted_by_what_makes_them_difficult() -> None:
    found = filtered(
        [entry(2.0, 0.5, "turn", "pedestrian"), entry(0.1, 0.1, "turn"), entry(3.0, 0.1)], Thresholds()
    )
    assert summary(found) == {
        "scenes": 3,
        "kept": 2,
        "plans": 4,
        "tags": {
            "pedestrian": {"scenes": 1, "kept": 1},
            "quiet": {"scenes": 1, "kept": 1},
            "turn": {"scenes": 2, "kept": 1},
        },
    }


def test_a_picture_shows_each_scene_where_it_lies(tmp_path: Path) -> None:
    below = filtered([entry(4.0, 0.2) for _ in range(3)], Thresholds())
    scatter(below, Thresholds(), tmp_path / "below.png")
    scatter(filtered([entry(0.2, 4.0)], Thresholds()), Thresholds(), tmp_path / "above.png")
    one, other = (decode_image((tmp_path / f"{name}.png").read_bytes()) for name in ("below", "above"))
    assert one.shape == other.shape
    assert (one != other).any()
