from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from looktwice.model.families.picture_codes import VisualCodesError
from looktwice.model.network.composer import Composer
from looktwice.model.network.visual_codes import Seen, VisualCodes, load_visual_codes
from tests.model.network.test_visual_codes import picture

CODES = list(range(98))


def seen(*seeds: int) -> Seen:
    return np.stack([picture(seed) for seed in seeds])


@pytest.fixture
def composing() -> VisualCodes:
    torch.manual_seed(0)
    return VisualCodes(24, composes=True).eval()


def composer_of(codes: VisualCodes) -> Composer:
    assert codes.composer is not None
    return codes.composer


def taking(codes: VisualCodes, share: float) -> None:
    """Have the composer take all of the moved picture, or nothing, and leave the painted one as it is."""
    finish = composer_of(codes).finish[0]
    assert isinstance(finish, nn.Conv2d)
    assert finish.bias is not None
    with torch.no_grad():
        finish.weight.zero_()
        finish.bias.zero_()
        finish.bias[:16] = share


def test_codes_without_a_composer_paint_without_what_was_seen() -> None:
    torch.manual_seed(0)
    plain = VisualCodes(24).eval()
    np.testing.assert_array_equal(plain.decode(CODES, seen(0, 1)), plain.decode(CODES))


def test_a_picture_is_taken_from_the_moved_one_or_painted(composing: VisualCodes) -> None:
    taking(composing, 50.0)
    np.testing.assert_array_equal(composing.decode(CODES, seen(0, 1)), picture(1))
    taking(composing, -50.0)
    np.testing.assert_array_equal(composing.decode(CODES, seen(0, 1)), composing.decode(CODES))


def test_it_looks_elsewhere_in_the_moved_picture(composing: VisualCodes) -> None:
    taking(composing, 50.0)
    to_the_right = composer_of(composing).look.bias
    assert to_the_right is not None
    with torch.no_grad():
        # A tenth of half a picture: 11.2 pixels.
        to_the_right[0] = 1.0
    moved = seen(0, 0)
    moved[-1, :, :100] = 0
    moved[-1, :, 100:] = 200
    found = composing.decode(CODES, moved)[50, :, 0]
    assert (found[:88] == 0).all()
    assert (found[90:] == 200).all()


def test_what_was_seen_and_both_codes_count(composing: VisualCodes) -> None:
    composed = composing.decode(CODES, seen(0, 1))
    assert composed.shape == (112, 224, 3)
    assert (composed != composing.decode(CODES)).any()
    assert (composed != composing.decode(CODES, seen(0, 2))).any()
    assert (composed != composing.decode(CODES, seen(2, 1))).any()
    assert (composed != composing.decode(CODES[::-1], seen(0, 1))).any()


def test_a_composer_is_kept_with_its_codes(composing: VisualCodes, tmp_path: Path) -> None:
    composing.save(tmp_path, {})
    again = load_visual_codes(tmp_path)
    np.testing.assert_array_equal(again.decode(CODES, seen(0, 1)), composing.decode(CODES, seen(0, 1)))


def test_moved_pictures_of_other_sizes_are_refused(composing: VisualCodes) -> None:
    with pytest.raises(VisualCodesError, match="uint8"):
        composing.decode(CODES, np.stack([picture(1, 56, 112)] * 2))
    with pytest.raises(VisualCodesError, match="2 pictures, got 3"):
        composing.decode(CODES, seen(0, 1, 2))
