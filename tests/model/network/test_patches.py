from __future__ import annotations

import numpy as np
from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

from looktwice.model.network.patches import PIXEL_MEAN, PIXEL_STD, normalise, patchify, resize
from looktwice.model.network.vla_settings import VlaSettings

SETTINGS = VlaSettings(image_width=112, image_height=56)


def test_one_by_one_reference() -> None:
    frames = np.random.default_rng(0).integers(0, 256, (4, 56, 112, 3), np.uint8)
    patches = patchify(frames, SETTINGS)
    row = 0
    for slice_ in range(2):
        for block_y in range(2):
            for block_x in range(4):
                for y, x in ((0, 0), (0, 1), (1, 0), (1, 1)):
                    top, left = 14 * (2 * block_y + y), 14 * (2 * block_x + x)
                    patch = frames[2 * slice_ : 2 * slice_ + 2, top : top + 14, left : left + 14]
                    np.testing.assert_array_equal(patches[row], patch.transpose(3, 0, 1, 2).ravel())
                    row += 1
    assert row == len(patches)


def test_equals_the_processor_of_transformers() -> None:
    # A still picture is a clip whose frames are equal in pairs.
    picture = np.random.default_rng(1).integers(0, 256, (56, 112, 3), np.uint8)
    processor = Qwen2VLImageProcessorPil(patch_size=14, temporal_patch_size=2, merge_size=2, do_resize=False)
    theirs = processor(images=[picture], return_tensors="np")
    ours = normalise(patchify(np.stack([picture, picture]), SETTINGS))
    np.testing.assert_allclose(ours, theirs["pixel_values"], atol=2e-6)
    np.testing.assert_array_equal(theirs["image_grid_thw"], [[1, 4, 8]])


def test_normalise_each_channel() -> None:
    grey = np.full((1, 1176), 100, np.uint8)
    values = normalise(grey).reshape(3, -1)
    for channel in range(3):
        expected = (100 / 255 - PIXEL_MEAN[channel]) / PIXEL_STD[channel]
        np.testing.assert_allclose(values[channel], expected, rtol=1e-6)


def test_resize_only_where_needed() -> None:
    picture = np.zeros((56, 112, 3), np.uint8)
    assert resize(picture, SETTINGS) is picture
    assert resize(np.zeros((300, 500, 3), np.uint8), SETTINGS).shape == (56, 112, 3)
