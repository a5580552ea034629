"""What labelled scenes contain: how often each difficulty, each meta-action and each mistake occurs."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any, Final

import numpy as np

from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.lead import LEAD_WITHIN_M, lead_within
from looktwice.model.driving.metrics import collides, leaves_road
from looktwice.model.driving.plan import GROUPS, TICKS, WORDS, Plan
from looktwice.model.driving.scene import TAGS, LabelledScene
from looktwice.model.driving.scene_store import MANIFEST, SceneFileError, read_scenes
from looktwice.model.driving.trajectory import HORIZON_S, STEP_S

_ALL_WORDS: Final = tuple(word for group in GROUPS for word in WORDS[group])
_TURNS: Final = ("Left Turn", "Right Turn")
_ENDED_BADLY: Final = ("collision", "off_road")


def scene_stats(path: Path) -> dict[str, Any]:
    """Count what the scenes of a file or folder hold.

    ``tags`` and ``meta_actions`` count scenes, shares are of scenes, ``meta_action_time`` is the share of the
    seconds that plans cover. ``expert_off_road`` is None where no scene tells where the road is.
    """
    tags: Counter[str] = Counter()
    words_in: Counter[str] = Counter()
    word_ticks: Counter[str] = Counter()
    episodes: set[str] = set()
    collisions = off_road = roads = near = turning = scenes = stationary = 0
    speeds, accelerations, jerks = [], [], []
    for labelled in read_scenes(path, dense=False):
        scenes += 1
        episodes.add(labelled.episode_id)
        tags.update(labelled.tags)
        plan = expert_plan(labelled)
        ticks = _word_ticks(plan)
        words_in.update(ticks.keys())
        word_ticks.update(ticks)
        turning += any(word in ticks for word in _TURNS)
        future = labelled.future[None]
        collisions += bool(collides(future, labelled.agents, HORIZON_S)[0])
        if labelled.drivable:
            roads += 1
            off_road += bool(leaves_road(future, labelled.drivable)[0])
        near += lead_within(labelled)
        speed = _speeds(labelled)
        speeds.append(speed.mean())
        stationary += int((np.abs(speed) < 0.2).sum())
        acceleration = np.diff(speed) / STEP_S
        accelerations.append(acceleration)
        jerks.append(np.abs(np.diff(np.convolve(acceleration, np.full(3, 1 / 3), "valid"))) / STEP_S)
    if not scenes:
        raise SceneFileError(f"{path} holds no scenes")
    acceleration, jerk = np.concatenate(accelerations), np.concatenate(jerks)
    return {
        "scenes": scenes,
        "episodes": len(episodes),
        "tags": {tag: tags[tag] for tag in TAGS},
        "meta_actions": {word: words_in[word] for word in _ALL_WORDS},
        "meta_action_time": {word: word_ticks[word] / (TICKS * scenes) for word in _ALL_WORDS},
        "expert_collisions": collisions,
        "expert_off_road": off_road if roads else None,
        "turning_share": turning / scenes,
        "mean_speed_ms": float(np.mean(speeds)),
        "stationary_share_of_time": stationary / (len(speeds) * 64),
        f"lead_within_{LEAD_WITHIN_M:.0f}_m_share": near / scenes,
        "acceleration_p01": float(np.percentile(acceleration, 1)),
        "acceleration_p99": float(np.percentile(acceleration, 99)),
        "jerk_p99": float(np.percentile(jerk, 99)),
        **_outcomes(path),
    }


def _word_ticks(plan: Plan) -> Counter[str]:
    ticks: Counter[str] = Counter()
    for track in (plan.longitudinal, plan.lateral, plan.lane):
        for action in track or ():
            ticks[action.word] += action.end - action.start
    return ticks


def _speeds(labelled: LabelledScene) -> Any:
    poses = np.concatenate([labelled.scene.history[-1:], labelled.future]).astype(np.float64)
    step = np.diff(poses[:, :2], axis=0)
    heading = 0.5 * (poses[1:, 3] + poses[:-1, 3])
    return (step[:, 0] * np.cos(heading) + step[:, 1] * np.sin(heading)) / STEP_S


def _outcomes(path: Path) -> dict[str, Any]:
    manifest = (path if path.is_dir() else path.parent) / MANIFEST
    if not manifest.exists():
        return {}
    outcomes: dict[str, int] = json.loads(manifest.read_text())["outcomes"]
    total = sum(outcomes.values())
    badly = sum(outcomes.get(name, 0) for name in _ENDED_BADLY)
    return {"outcomes": outcomes, "ended_badly_share": badly / total if total else 0.0}
