from __future__ import annotations

from dataclasses import replace

from looktwice.model.driving.scene import TAGS, LabelledScene, Tag
from looktwice.model.driving.selection import pick_varied
from tests.model.driving.drives import labelled_scene


def tagged(index: int, *tags: Tag, episode: int | None = None) -> LabelledScene:
    episode = index if episode is None else episode
    scene = labelled_scene(scene_id=str(index), episode_id=str(episode))
    return replace(scene, tags=frozenset(tags))


def test_every_tag_and_a_quiet_scene_are_shown() -> None:
    scenes = [tagged(index, "lead_vehicle") for index in range(20)]
    scenes += [tagged(20 + index, tag) for index, tag in enumerate(TAGS)] + [tagged(30)]
    picked = pick_varied(scenes, 7)
    assert len(picked) == 7
    assert {tag for scene in picked for tag in scene.tags} == set(TAGS)
    assert any(not scene.tags for scene in picked)


def test_an_episode_is_shown_once() -> None:
    scenes = [tagged(index, "turn", episode=index // 5) for index in range(20)]
    picked = pick_varied(scenes, 12)
    assert len(picked) == 4
    assert len({scene.episode_id for scene in picked}) == 4
