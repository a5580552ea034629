from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from looktwice.model.evaluation.bootstrap import compare, mean_interval
from looktwice.model.evaluation.open_loop import SceneResult, evaluate_trajectories
from tests.model.driving.drives import labelled_scene

SCENE = labelled_scene()
BASE = evaluate_trajectories(SCENE, SCENE.future[None])


def results(values: list[list[float | None]], measure: str = "min_ade_m") -> list[SceneResult]:
    """One list per episode, one value per scene."""
    return [
        replace(BASE, scene_id=f"{e}/{s}", episode_id=str(e), **{measure: value})  # type: ignore[arg-type]
        for e, episode in enumerate(values)
        for s, value in enumerate(episode)
    ]


def random_results(seed: int, episodes: int, scenes: int, between: float, within: float) -> list[SceneResult]:
    random = np.random.default_rng(seed)
    return results(
        [
            (5 + between * random.normal() + within * random.normal(size=scenes)).tolist()
            for _ in range(episodes)
        ]
    )


def test_the_mean_is_over_scenes() -> None:
    mean, _ = mean_interval(results([[1.0], [2.0, 3.0, 6.0]]), "min_ade_m")
    assert mean == pytest.approx(3.0)


def test_the_interval_is_as_wide_as_theory_says() -> None:
    # 100 episodes with means of spread 1: the standard error is 0.1, whatever the number of scenes within.
    mean, interval = mean_interval(random_results(1, 100, 20, between=1.0, within=0.0), "min_ade_m")
    assert mean is not None
    assert interval is not None
    assert interval[0] < mean < interval[1]
    assert interval[1] - interval[0] == pytest.approx(2 * 1.96 * 0.1, rel=0.25)


def test_scenes_of_one_episode_are_not_counted_as_independent() -> None:
    _, alike = mean_interval(random_results(2, 30, 40, between=1.0, within=0.0), "min_ade_m")
    _, apart = mean_interval(random_results(2, 1200, 1, between=1.0, within=0.0), "min_ade_m")
    assert alike is not None
    assert apart is not None
    assert alike[1] - alike[0] > 4 * (apart[1] - apart[0])


def test_episodes_of_any_length_weigh_by_their_scenes() -> None:
    _, interval = mean_interval(results([[4.0], [4.0] * 9, [4.0] * 3]), "min_ade_m")
    assert interval == pytest.approx((4.0, 4.0))


def test_scenes_without_the_measure_do_not_count() -> None:
    with_gaps = results([[1.0, None], [None, None], [3.0]], "think_rate")
    assert mean_interval(with_gaps, "think_rate")[0] == pytest.approx(2.0)
    assert mean_interval(results([[None], [None]], "think_rate"), "think_rate") == (None, None)


def test_the_same_results_give_the_same_interval() -> None:
    some = random_results(3, 20, 3, between=1.0, within=1.0)
    assert mean_interval(some, "min_ade_m") == mean_interval(some, "min_ade_m")
    _, interval = mean_interval(some, "min_ade_m")
    assert mean_interval(list(reversed(some)), "min_ade_m")[1] == pytest.approx(interval)


def test_a_paired_comparison_sees_what_separate_intervals_do_not() -> None:
    against = random_results(4, 40, 5, between=2.0, within=0.5)
    worse = [replace(result, min_ade_m=result.min_ade_m * 1.1) for result in against]
    one, other = mean_interval(worse, "min_ade_m")[1], mean_interval(against, "min_ade_m")[1]
    assert one is not None
    assert other is not None
    assert one[0] < other[1]  # the intervals overlap
    comparison = compare("worse", worse, list(reversed(against)))
    assert comparison.scenes == 200
    assert comparison.ratio == pytest.approx(1.1)
    assert comparison.ratio_interval == pytest.approx((1.1, 1.1))
    assert 0 < comparison.difference_interval[0] < comparison.difference < comparison.difference_interval[1]


def test_comparing_with_zero_has_a_difference_and_no_ratio() -> None:
    comparison = compare("crashes", results([[1.0], [0.5]]), results([[0.0], [0.0]]))
    assert comparison.difference == pytest.approx(0.75)
    assert (comparison.ratio, comparison.ratio_interval) == (None, None)


def test_only_the_same_scenes_are_compared() -> None:
    with pytest.raises(ValueError, match="not of the same scenes"):
        compare("x", results([[1.0]]), results([[1.0, 2.0]]))
    with pytest.raises(ValueError, match="no scene has think_rate in both"):
        compare("x", results([[1.0]]), results([[1.0]]), "think_rate")
