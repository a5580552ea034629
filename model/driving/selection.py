"""Choosing a few scenes that show much."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from looktwice.model.driving.scene import LabelledScene, Tag


def pick_varied(scenes: Iterable[LabelledScene], count: int) -> list[LabelledScene]:
    """At most ``count`` scenes, one an episode at most, every tag about equally often.

    Greedy: each next scene is the first one that shows the tag picked least so far, from an unused episode;
    quiet scenes count as a tag of their own. The order is that of picking.
    """
    candidates = list(scenes)
    kinds: list[Tag | None] = [*sorted({tag for scene in candidates for tag in scene.tags}), None]
    seen: Counter[Tag | None] = Counter()
    episodes: set[str] = set()
    picked: list[LabelledScene] = []
    while len(picked) < count:
        free = [scene for scene in candidates if scene.episode_id not in episodes]
        shown = [kind for kind in kinds if any(_shows(scene, kind) for scene in free)]
        if not shown:
            break
        rarest = min(shown, key=lambda kind: seen[kind])
        best = next(scene for scene in free if _shows(scene, rarest))
        picked.append(best)
        episodes.add(best.episode_id)
        seen.update(best.tags or {None})
    return picked


def _shows(scene: LabelledScene, kind: Tag | None) -> bool:
    return not scene.tags if kind is None else kind in scene.tags
