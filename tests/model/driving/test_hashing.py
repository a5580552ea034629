from __future__ import annotations

from dataclasses import replace

import numpy as np

from looktwice.model.bundled import SCENES
from looktwice.model.driving.hashing import annotations_hash, hash_of, judged_hash
from looktwice.model.driving.lane_map import LaneArea, LaneMap
from looktwice.model.driving.scene import AgentKind
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.trajectory import constant_velocity


def test_hashes_tell_parts_apart() -> None:
    assert hash_of("ab", "c") != hash_of("a", "bc") != hash_of("abc")
    assert hash_of(b"1") != hash_of("1")
    assert hash_of({"a": 1, "b": 2}) == hash_of({"b": 2, "a": 1})


def test_annotations_are_told_apart_by_whatever_a_teacher_may_read() -> None:
    labelled = next(read_scenes(SCENES))
    assert labelled.agents
    first, *rest = labelled.agents
    moved = np.array(first.poses)
    moved[..., 0] += 0.5
    other: AgentKind = "barrier" if first.kind == "cone" else "cone"
    changed = [
        labelled,
        replace(labelled, agents=tuple(rest)),
        replace(labelled, agents=(replace(first, kind=other), *rest)),
        replace(labelled, agents=(replace(first, poses=moved), *rest)),
        replace(labelled, tags=labelled.tags ^ {"turn"}),
        replace(labelled, future=constant_velocity(labelled.scene.history)),
        replace(labelled, lane_lines=labelled.lane_lines[1:]),
    ]
    assert len({annotations_hash(each) for each in changed}) == len(changed)
    assert annotations_hash(labelled) == annotations_hash(next(read_scenes(SCENES)))


def test_what_plans_are_judged_by_holds_the_lane_map_too() -> None:
    corner = np.array([[0.0, 0.0], [9.0, 0.0], [9.0, 4.0]], np.float32)
    first, *rest = (LaneArea(number, corner + number, on_route=number > 0) for number in range(2))
    known = LaneMap((first, *rest), (corner,), corner, has_lights=False)
    unknown = next(read_scenes(SCENES))
    labelled = replace(unknown, lane_map=known)
    changed = [
        unknown,
        labelled,
        replace(labelled, tags=labelled.tags ^ {"turn"}),
        *(
            replace(labelled, lane_map=each)
            for each in (
                replace(known, lanes=tuple(rest)),
                replace(known, lanes=(replace(first, on_route=not first.on_route), *rest)),
                replace(known, lanes=(replace(first, ring=first.ring + 0.5), *rest)),
                replace(known, intersections=()),
                replace(known, centreline=known.centreline + 0.5),
                replace(known, has_lights=not known.has_lights),
            )
        ),
    ]
    assert len({judged_hash(each) for each in changed}) == len(changed)
    assert judged_hash(labelled) == judged_hash(replace(next(read_scenes(SCENES)), lane_map=known))
