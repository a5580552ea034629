from __future__ import annotations

from looktwice.model.bench.workload import Workload
from tests.checkpoints import noisy_scene


def test_all_contenders_are_asked_the_same() -> None:
    load = Workload(3, 2, "always", "cf_vla", temperature=0.5)
    scenes = [noisy_scene(0), noisy_scene(1)]
    first, again, next_round = (load.requests(scenes, number) for number in (4, 4, 5))
    assert [each.request_id for each in first] == [each.request_id for each in again]
    assert [each.scene.clips for each in first] == [each.scene.clips for each in again]
    assert not {each.controls.seed for each in first} & {each.controls.seed for each in next_round}
    assert {(each.controls.n, each.controls.thinking, each.controls.temperature) for each in first} == {
        (2, "always", 0.5)
    }
