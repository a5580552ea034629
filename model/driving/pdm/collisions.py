"""What plans hit, whose fault it is, and what they come too close to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from looktwice.model.driving.pdm.geometry import Boxes, IndexArray, boxes_meet, near, segments_meet
from looktwice.model.driving.pdm.lanes import Areas
from looktwice.model.driving.pdm.world import STEP_S, STEPS, Array, BoolArray, TrackedBox

EGO_STOPPED_MPS: Final = 0.05
LOOK_AHEAD: Final = (0, 3, 6, 9)
"""Steps ahead at which a plan's constant velocity is compared with where others will be."""
STANDING_MPS: Final = 5e-3
"""Slower than this, nothing comes too close."""
_AHEAD_RAD: Final = float(np.deg2rad(30))
_BEHIND_RAD: Final = float(np.deg2rad(150))
_NEVER: Final = np.iinfo(np.intp).max


@dataclass(frozen=True, eq=False)
class SubScore:
    """A sub-score about others, [n] each.

    Attributes:
        scores: NaN where the layers that would decide are not known.
        first_step: the step of the first failure; -1 where there is none.
        track: which track it was with; -1 where none.
    """

    scores: Array
    first_step: IndexArray
    track: IndexArray


def track_boxes(tracks: tuple[TrackedBox, ...], steps: int) -> Boxes:
    """The tracks' boxes [steps, a]; absent ones are NaN and meet nothing."""
    poses = np.full((steps, len(tracks), 3), np.nan)
    for number, track in enumerate(tracks):
        poses[:, number] = track.poses[:steps]
    length = np.array([track.length_m for track in tracks])
    width = np.array([track.width_m for track in tracks])
    return Boxes.of(poses[..., 0], poses[..., 1], poses[..., 2], length, width)


def at_fault(
    ego: Boxes, states: Array, speeds: Array, others: Boxes, tracks: tuple[TrackedBox, ...], areas: Areas
) -> SubScore:
    """No at-fault collision: 0 after hitting an agent by one's own fault, 0.5 after hitting a thing.

    What touches a plan first without its fault is left out from then on, so that a pair's first contact
    decides.

    Args:
        ego: boxes [n, 41].
        states: [n, 41, 11].
        speeds: m/s, [n, 41].
        others: boxes [41 or more, a].
        tracks: the others.
        areas: of the ego boxes.
    """
    plans, steps, which = near(ego, others[: STEPS + 1])
    meets = boxes_meet(ego[plans, steps], others[steps, which])
    plans, steps, which = _first(plans[meets], which[meets], steps[meets], len(tracks))
    agent = np.array([track.is_agent for track in tracks], dtype=np.bool_)[which]
    stopped = np.array([track.is_stopped for track in tracks], dtype=np.bool_)[which]
    hit = others[steps, which]
    body = ego[plans, steps]
    corners = body.corners()
    front = segments_meet(corners[:, 0], corners[:, 3], hit)
    moving = speeds[plans, steps] > EGO_STOPPED_MPS
    behind = _angle(states[plans, steps], hit) > _BEHIND_RAD
    plain = moving & (stopped | (~behind & front))
    aside = moving & ~plain & ~behind
    return _verdict(
        len(ego.x), plans, steps, which, plain, aside, _at(areas.outside, plans, steps),
        areas.outside_is_known, np.where(agent, 0.0, 0.5),
    )  # fmt: skip


def too_close(
    ego: Boxes, states: Array, speeds: Array, others: Boxes, count: int, areas: Areas, last_step: int
) -> SubScore:
    """Time to collision: 0 where going straight on for 0.9 s would hit something ahead.

    Args:
        ego: boxes [n, 41].
        states: [n, 41, 11].
        speeds: m/s, [n, 41].
        others: boxes [last_step + 10 or more, a].
        count: how many others there are.
        areas: of the ego boxes.
        last_step: the last step that is looked at.
    """
    found = []
    for place, ahead in enumerate(LOOK_AHEAD):
        shift = speeds[:, : last_step + 1] * (ahead * STEP_S)
        moved = ego[:, : last_step + 1]
        moved = Boxes(
            moved.x + moved.cos * shift, moved.y + moved.sin * shift,
            moved.cos, moved.sin, moved.half_length, moved.half_width,
        )  # fmt: skip
        there = others[ahead : ahead + last_step + 1]
        plans, steps, which = near(moved, there)
        keep = speeds[plans, steps] >= STANDING_MPS
        plans, steps, which = plans[keep], steps[keep], which[keep]
        keep = boxes_meet(moved[plans, steps], there[steps, which])
        found.append((plans[keep], which[keep], len(LOOK_AHEAD) * steps[keep] + place))
    plans, which, order = (np.concatenate(each) for each in zip(*found, strict=True))
    plans, order, which = _first(plans, which, order, count)
    steps, seen = order // len(LOOK_AHEAD), order % len(LOOK_AHEAD)
    angle = _angle(states[plans, steps], others[steps + np.array(LOOK_AHEAD)[seen], which])
    ahead_ = angle < _AHEAD_RAD
    aside = ~ahead_ & ~(angle > _BEHIND_RAD)
    outside, crossing = areas.outside, areas.axle_crossing
    known = [each for each in (outside, crossing) if each is not None]
    decides = np.logical_or.reduce(known) if known else None
    return _verdict(
        len(ego.x), plans, steps, which, ahead_, aside, _at(decides, plans, steps),
        areas.outside_is_known and crossing is not None, np.zeros(len(plans)),
    )  # fmt: skip


def _first(
    plans: IndexArray, which: IndexArray, order: IndexArray, count: int
) -> tuple[IndexArray, IndexArray, IndexArray]:
    """Of each pair (plan, other) the first in order: plans, orders, others."""
    if not len(plans):
        return plans, order, which
    pairs, place = np.unique(plans * count + which, return_inverse=True)
    first = np.full(len(pairs), _NEVER, dtype=np.intp)
    np.minimum.at(first, place, order)
    return pairs // count, first, pairs % count


def _angle(states: Array, boxes: Boxes) -> Array:
    """Between a rear axle's heading and the way to boxes' centres, in radians."""
    x, y = boxes.x - states[:, 0], boxes.y - states[:, 1]
    with np.errstate(invalid="ignore"):
        cosine = (x * np.cos(states[:, 2]) + y * np.sin(states[:, 2])) / np.hypot(x, y)
    angle: Array = np.arccos(np.clip(cosine, -1.0, 1.0))
    return angle


def _at(flags: BoolArray | None, plans: IndexArray, steps: IndexArray) -> BoolArray:
    return np.zeros(len(plans), dtype=np.bool_) if flags is None else flags[plans, steps]


def _verdict(
    count: int,
    plans: IndexArray,
    steps: IndexArray,
    which: IndexArray,
    plain: BoolArray,
    aside: BoolArray,
    outside: BoolArray,
    outside_is_known: bool,
    values: Array,
) -> SubScore:
    """Plain failures count, those aside count outside; where that is not known they leave it open."""
    scores, open_ = np.ones(count), np.zeros(count, dtype=np.bool_)
    fails = plain | (aside & outside)
    np.minimum.at(scores, plans[fails], values[fails])
    if not outside_is_known:
        undecided = aside & ~outside
        open_[plans[undecided & (values < scores[plans])]] = True
    first, track = np.full(count, -1, dtype=np.intp), np.full(count, -1, dtype=np.intp)
    late = np.lexsort((which[fails], steps[fails]))[::-1]
    first[plans[fails][late]], track[plans[fails][late]] = steps[fails][late], which[fails][late]
    scores[open_] = np.nan
    return SubScore(scores, first, track)
