from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE, Scene, SceneError
from looktwice.model.families.family import FamilyError
from looktwice.model.network.chat_prompt import prompt_text
from looktwice.model.network.inputs import InputBuilder, rotary_positions
from looktwice.model.network.vla_settings import NANO_SETTINGS, SettingsError, VlaSettings
from looktwice.model.network.vocabulary import HISTORY, ROUTE, VIDEO_PAD, Vocabulary
from tests.model.network.conftest import made_up_scene

SETTINGS = VlaSettings(codec_size=16)


def test_a_scene_becomes_inputs(vocabulary: Vocabulary, scene: Scene) -> None:
    inputs = InputBuilder(vocabulary, SETTINGS).build(scene, "cf_vla")
    ids = inputs.prompt.ids
    assert (ids == vocabulary.id_of(VIDEO_PAD)).sum() == 128
    assert (ids == vocabulary.id_of(HISTORY)).sum() == 1
    assert (ids == vocabulary.id_of(ROUTE)).sum() == 1
    assert inputs.patches.shape == (512, 1176)
    assert inputs.patches.dtype == np.uint8
    assert inputs.pixel_values_videos.dtype == np.float32
    np.testing.assert_array_equal(inputs.video_grid_thw, [[2, 8, 16], [2, 8, 16]])
    assert inputs.route is not None
    assert len(ids) - 128 <= 72, "the text of a prompt is meant to be short"


def test_cameras_in_the_order_of_the_checkpoint(vocabulary: Vocabulary, scene: Scene) -> None:
    slices = InputBuilder(vocabulary, SETTINGS).slices(scene)
    assert slices == [
        scene.clip(camera).images[start : start + 2]
        for camera in (FRONT_WIDE, FRONT_TELE)
        for start in (0, 2)
    ]


def test_prompts_share_their_beginning(vocabulary: Vocabulary) -> None:
    builder = InputBuilder(vocabulary, SETTINGS)
    scenes = made_up_scene(1), made_up_scene(1, route=False)
    with_route, without = (builder.build(scene, "cf_vla").prompt for scene in scenes)
    whole = "".join(prompt_text("cf_vla", SETTINGS, route=False))
    assert without.ids.tolist() == list(vocabulary.encode(whole))
    history = int(np.flatnonzero(without.ids == vocabulary.id_of(HISTORY))[0])
    np.testing.assert_array_equal(with_route.ids[: history + 1], without.ids[: history + 1])
    assert vocabulary.decode(without.ids).endswith("<|im_end|>\n<|im_start|>assistant\n")
    assert builder.build(scenes[1], "traj_only").prompt.ids.shape != without.ids.shape
    assert builder.longest_prompt("cf_vla") == len(with_route.ids)


def test_without_route(vocabulary: Vocabulary) -> None:
    scene = made_up_scene(1, route=False)
    assert InputBuilder(vocabulary, SETTINGS).build(scene, "cf_vla").route is None
    blind = InputBuilder(vocabulary, replace(SETTINGS, with_route=False))
    inputs = blind.build(made_up_scene(1), "cf_vla")
    assert inputs.route is None
    assert not (inputs.prompt.ids == vocabulary.id_of(ROUTE)).any()


def test_what_cannot_be_built(vocabulary: Vocabulary, scene: Scene) -> None:
    builder = InputBuilder(vocabulary, SETTINGS)
    with pytest.raises(FamilyError, match="poem"):
        builder.build(scene, "poem")
    with pytest.raises(SceneError, match=FRONT_WIDE):
        builder.build(Scene("x", scene.clips[:1], scene.history), "cf_vla")


def test_rotary_positions_of_a_small_clip() -> None:
    settings = VlaSettings(image_width=56, image_height=28)  # 2 slices of 1 x 2 tokens
    is_video = np.array([False, *[True] * 4, False])
    np.testing.assert_array_equal(
        rotary_positions(is_video, settings),
        [[0, 1, 1, 5, 5, 3], [0, 1, 1, 1, 1, 3], [0, 1, 2, 1, 2, 3]],
    )
    with pytest.raises(ValueError, match="placeholders"):
        rotary_positions(is_video[:4], settings)


def test_settings_that_do_not_fit() -> None:
    assert VlaSettings.from_dict(SETTINGS.to_dict()) == SETTINGS
    assert VlaSettings.from_dict(NANO_SETTINGS.to_dict()) == NANO_SETTINGS
    # Checkpoints that were written before reflections had languages stay what they are.
    assert "reflection" not in SETTINGS.to_dict()
    with pytest.raises(SettingsError, match="unknown language of reflections 'Latin'"):
        VlaSettings.from_dict({"reflection": "Latin"})
    with pytest.raises(SettingsError, match="multiple of 28"):
        VlaSettings(image_width=200)
    with pytest.raises(SettingsError, match="unknown camera"):
        VlaSettings(cameras=("periscope",))
    with pytest.raises(SettingsError, match="must divide"):
        VlaSettings(temporal_patch_size=3)
    with pytest.raises(SettingsError, match="at least one"):
        VlaSettings(formats=())
    with pytest.raises(SettingsError, match="not LookTwice"):
        VlaSettings.from_dict({"colour": "red"})
