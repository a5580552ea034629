"""Convolutions beside the tower see the last two pictures, and leave everything else as it was."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from looktwice.model.driving.cameras import CAMERA_SPECS
from looktwice.model.driving.facts import FACT_GROUPS, WALKER_FIELDS
from looktwice.model.driving.route_frame import RouteFrame
from looktwice.model.driving.scene import CLIP_FRAMES
from looktwice.model.network.checkpoint import Loaded, load, save, with_fine_vision
from looktwice.model.network.fine_vision import TOLD, FineVision, channels_of
from looktwice.model.network.patches import normalise, patchify
from looktwice.model.network.resampler import CrossLayer, SpottedReader
from looktwice.model.network.vla_settings import NANO_SETTINGS, SPOTTED, SettingsError, VlaSettings
from tests.model.training.scenes import training_scene


@pytest.fixture(scope="module")
def plain(resampling_checkpoint: Path) -> Loaded:
    return load(resampling_checkpoint)


@pytest.fixture(scope="module")
def fine(plain: Loaded) -> Loaded:
    return with_fine_vision(plain)


@pytest.mark.parametrize("merge", [1, 2])
def test_the_last_two_pictures_of_each_clip_are_found_in_its_patches(merge: int) -> None:
    settings = VlaSettings(
        image_width=84,
        image_height=56,
        temporal_patch_size=CLIP_FRAMES,
        spatial_merge_size=merge,
        fine_vision=True,
        scene_tokens=40,
    )
    clips = len(settings.cameras)
    frames = np.random.default_rng(0).integers(0, 256, (clips * CLIP_FRAMES, 56, 84, 3), np.uint8)
    patches = patchify(frames, settings)
    seen = FineVision(32, settings)
    found = seen.pictures(torch.from_numpy(patches))
    last = frames.reshape(clips, CLIP_FRAMES, 56, 84, 3)[:, -2:].transpose(0, 1, 4, 2, 3)
    np.testing.assert_array_equal(found.numpy(), last)
    tokens = seen(torch.from_numpy(patches))
    assert tokens.shape == (clips, settings.fine_tokens, 32)
    torch.testing.assert_close(seen(torch.from_numpy(normalise(patches))), tokens, atol=1e-4, rtol=1e-4)


def test_a_checkpoint_gets_them_beside_what_it_has(plain: Loaded, fine: Loaded, tmp_path: Path) -> None:
    settings = fine.settings
    assert settings.vision_tokens == plain.settings.vision_tokens + 2 * settings.fine_tokens
    scene = training_scene(0).scene
    inputs = plain.inputs.build(scene, "traj_only")
    patches, grids = torch.from_numpy(inputs.patches), torch.from_numpy(inputs.video_grid_thw)
    before, after = (each.model.vision(patches, grids) for each in (plain, fine))
    clips = len(settings.cameras)
    of_tower = after.view(clips, -1, after.shape[-1])[:, : settings.clip_tokens]
    torch.testing.assert_close(of_tower.flatten(0, 1), before)
    old, new = plain.model.state_dict(), fine.model.state_dict()
    assert all(torch.equal(old[name], new[name]) for name in old)
    added = {name for name in new if name not in old}
    assert {".".join(name.split(".")[:2]) for name in added if not name.startswith("fine_vision.")} == {
        "resampler.spotted",
        "resampler.people_layers",
        "resampler.fine_layer",
    }
    history, route = torch.tensor(inputs.history)[None], torch.zeros(1, 20, 2)
    told, beside = (
        each.model.resampler.gather(tokens[None], history, route, torch.zeros(1, dtype=torch.bool))[0]
        for each, tokens in ((plain, before), (fine, after))
        if each.model.resampler is not None
    )
    of_people = [place for place, fields in enumerate(FACT_GROUPS) if fields == WALKER_FIELDS]
    others = [place for place in range(len(told)) if place not in of_people]
    torch.testing.assert_close(beside[others], told[others], msg="nothing is added before it is learned")
    assert not torch.allclose(beside[of_people], told[of_people])
    save(tmp_path / "fine", fine.model, fine.vocabulary, fine.codec)
    again = load(tmp_path / "fine")
    assert again.settings == settings
    torch.testing.assert_close(again.model.vision(patches, grids), after)


@pytest.mark.parametrize("lacking", [{"scene_tokens": 0}, {"temporal_patch_size": 2}])
def test_they_need_whole_clips_and_somebody_who_reads_them(lacking: dict[str, Any]) -> None:
    with pytest.raises(SettingsError, match="need whole clips as one slice, and a resampler"):
        replace(NANO_SETTINGS, fine_vision=True, sketch_tokens=0, **lacking)
    assert NANO_SETTINGS.fine_tokens == 0


def test_the_likeliest_of_each_kind_are_told_first(fine: Loaded) -> None:
    """Two people and a vehicle stand in a picture of 11 x 21 places."""
    seen = fine.model.fine_vision
    assert seen is not None
    logits = torch.full((1, len(SPOTTED), 11, 21), -9.0)
    logits[0, 0, 5, 3], logits[0, 0, 2, 18], logits[0, 0, 2, 17], logits[0, 1, 6, 10] = 2.0, 4.0, 3.0, 1.0
    away_log, shift, half_log, nearer_log = torch.zeros(4, 1, 11, 21)
    away_log[0, 2, 18], away_log[0, 5, 3], shift[0, 2, 18] = 3.0, 2.0, 0.25
    told_so = torch.cat([logits[0], away_log, shift, half_log, nearer_log])[None]
    hook = seen.head.register_forward_hook(lambda *_: told_so)
    with torch.no_grad():
        found = seen.find(torch.randn(1, 2, 3, 168, 336))
        [tokens] = seen.tokens(found)
    hook.remove()
    features = found.features
    assert tokens.shape == (fine.settings.fine_tokens, 256)
    first, second, third = (dict(zip(TOLD, each.tolist(), strict=False)) for each in tokens[:3])
    assert first["likely"] > second["likely"] > 0.8 > 0.01 > third["likely"], "none beside a likelier one"
    assert (first["away_log"], second["away_log"]) == (3.0, 2.0)
    assert first["across"] == pytest.approx(2 * 18.75 / 21 - 1, abs=1e-5)
    assert second["across"] < 0 < second["down"] + 0.1
    vehicle = tokens[SPOTTED["pedestrian"]]
    assert vehicle[0] == pytest.approx(0.73, abs=0.01)
    there = vehicle[len(TOLD) : len(TOLD) + channels_of(256)]
    torch.testing.assert_close(there, features[0, :, 6, 10] * vehicle[0])
    assert not tokens[:, len(TOLD) + channels_of(256) :].any()


@pytest.mark.parametrize("camera", [*CAMERA_SPECS])
def test_where_those_are_who_are_spotted_is_told_in_the_ego_s_frame(camera: str) -> None:
    """Somebody 20 m off, a little beside the middle of the picture."""
    reader, spec = SpottedReader(64, [camera], 1), CAMERA_SPECS[camera]
    across, away_m = 0.3, 20.0
    told = torch.zeros(len(TOLD))
    told[TOLD.index("likely")], told[TOLD.index("across")] = 1.0, across
    told[TOLD.index("away_log")] = float(np.log1p(away_m))
    tokens = torch.nn.functional.pad(told, (0, 64 - len(TOLD))).view(1, 1, 1, 64)
    column = spec.width / 2 * (1 + across)
    x_m, y_m, _ = spec.unproject(column, spec.horizon * spec.height, away_m)
    angles = 0.1 + 0.02 * np.arange(20)
    route = np.cumsum(4 * np.column_stack([np.cos(angles), np.sin(angles)]), axis=0).astype(np.float32)
    numbers: list[torch.Tensor] = []
    reader.told.register_forward_pre_hook(lambda _, arguments: numbers.append(arguments[0]))
    for has_route in (True, False):
        given = torch.from_numpy(route)[None], torch.tensor([has_route])
        assert reader(tokens, torch.zeros(1, 16, 4), *given).shape == (1, 1, 64)
    known, unknown = (each[0, 0, 0, len(TOLD) :].tolist() for each in numbers)
    assert known[:4] == unknown[:4] == pytest.approx([x_m / 20, np.clip(y_m, -30, 30) / 3, 0, 0], rel=1e-4)
    assert unknown[4:] == [0, 0]
    if x_m > 0:
        [[along_m, left_m]] = RouteFrame(route).places(np.array([[x_m, y_m]]))
        assert known[4:] == pytest.approx([along_m / 20, np.clip(left_m, -30, 30) / 3], abs=1e-3)


def test_people_are_read_from_the_convolutions_alone(fine: Loaded) -> None:
    torch.manual_seed(0)
    resampler = fine.model.resampler
    assert resampler is not None
    history, route, no_route = torch.zeros(1, 16, 4), torch.zeros(1, 20, 2), torch.zeros(1, dtype=torch.bool)
    tokens = torch.rand(1, 2, fine.settings.vision_tokens // 2, 256)
    other_tower, other_fine = tokens.clone(), tokens.clone()
    other_tower[:, :, : fine.settings.clip_tokens] += torch.randn(256)
    other_fine[:, :, fine.settings.clip_tokens :] += torch.rand(256)
    state, resampler.fine_layer = resampler.fine_layer, CrossLayer(256)
    told, by_tower, by_fine = (
        resampler.gather(each.flatten(1, 2), history, route, no_route)[0]
        for each in (tokens, other_tower, other_fine)
    )
    resampler.fine_layer = state
    for place, fields in enumerate(FACT_GROUPS):
        assert torch.equal(told[place], by_tower[place]) == (fields == WALKER_FIELDS)
        assert not torch.equal(told[place], by_fine[place])
