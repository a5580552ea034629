from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import load_file, save_file

from looktwice.model.driving.images import encode_png
from looktwice.model.families.picture_codes import (
    LEVELS,
    PICTURE_CODEBOOK,
    PICTURE_CODES,
    VisualCodesError,
    codes_of,
    levels_of,
)
from looktwice.model.network.visual_codes import (
    WEIGHTS_FILE,
    Frame,
    VisualCodes,
    batch_of,
    bounded,
    frame_of,
    load_visual_codes,
    quantised,
)

codes = st.integers(0, PICTURE_CODEBOOK - 1)


def picture(seed: int, height: int = 112, width: int = 224) -> Frame:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def small() -> VisualCodes:
    torch.manual_seed(0)
    return VisualCodes(width=24).eval()


@given(code=codes)
def test_a_code_is_its_levels(code: int) -> None:
    levels = levels_of(code)
    assert ((levels >= 0) & (levels < LEVELS)).all()
    assert codes_of(levels) == code


@given(levels=st.tuples(*(st.integers(0, count - 1) for count in LEVELS)))
def test_levels_are_their_code(levels: tuple[int, ...]) -> None:
    assert tuple(levels_of(codes_of(levels))) == levels


def test_there_are_a_thousand_codes_and_each_has_levels_of_its_own() -> None:
    assert (PICTURE_CODEBOOK, PICTURE_CODES) == (1000, 98)
    every = levels_of(np.arange(PICTURE_CODEBOOK).reshape(10, 100))
    assert every.shape == (10, 100, 4)
    assert len(np.unique(every.reshape(-1, 4), axis=0)) == PICTURE_CODEBOOK


@pytest.mark.parametrize("wrong", [[-1], [1000], [0.5]])
def test_other_numbers_are_no_codes(wrong: list[float]) -> None:
    with pytest.raises(VisualCodesError):
        levels_of(wrong)


@pytest.mark.parametrize("wrong", [[8, 0, 0, 0], [0, 0, 0, -1], [0, 0, 0], [0.0, 0, 0, 0]])
def test_other_numbers_are_no_levels(wrong: list[float]) -> None:
    with pytest.raises(VisualCodesError):
        codes_of(wrong)


def test_every_level_can_be_reached_and_none_beyond() -> None:
    free = torch.linspace(-12, 12, 4001)[:, None].expand(-1, 4)
    reached = bounded(free).round().to(torch.int64)
    assert [sorted(set(column.tolist())) for column in reached.T] == [list(range(count)) for count in LEVELS]


def test_gradients_pass_the_rounding_as_if_it_were_not_there() -> None:
    free = torch.randn(50, 4, generator=torch.Generator().manual_seed(0), requires_grad=True)
    weights = torch.arange(200.0).reshape(50, 4)
    levels = quantised(free)
    assert torch.equal(levels, levels.round())
    [through] = torch.autograd.grad((levels * weights).sum(), free)
    [smooth] = torch.autograd.grad((bounded(free) * weights).sum(), free)
    assert torch.equal(through, smooth)
    assert through.abs().max() > 0


def test_a_picture_becomes_codes_and_codes_a_picture(small: VisualCodes) -> None:
    frame = picture(0)
    written = small.encode(frame)
    assert written.shape == (PICTURE_CODES,)
    assert written.dtype == np.int64
    painted = small.decode(written)
    assert painted.shape == frame.shape
    assert painted.dtype == np.uint8
    # Training sees what use sees.
    with torch.no_grad():
        also_painted, levels = small(batch_of([frame]))
    np.testing.assert_array_equal(codes_of(levels[0].movedim(0, -1).long().numpy()).ravel(), written)
    assert (torch.from_numpy(painted).movedim(-1, 0) / 255 - also_painted[0].clamp(0, 1)).abs().max() < 0.003


def test_codes_do_not_depend_on_when_or_by_how_many_threads(small: VisualCodes) -> None:
    frames = [picture(seed) for seed in range(3)]
    before = [small.encode(frame) for frame in frames]
    torch.set_num_threads(2)
    after = [small.encode(frame) for frame in reversed(frames)][::-1]
    np.testing.assert_array_equal(before, after)
    np.testing.assert_array_equal(small.decode(before[0]), small.decode(after[0]))
    assert (before[0] != before[1]).any()


def test_a_code_paints_around_its_patch(small: VisualCodes) -> None:
    """The order of codes is that of the patches: row by row from the upper left."""
    written = small.encode(picture(1))
    changed = written.copy()
    changed[2 * 14 + 3] = (changed[2 * 14 + 3] + 500) % PICTURE_CODEBOOK
    apart = np.abs(small.decode(written).astype(int) - small.decode(changed)).sum(axis=2)
    row, column = (
        float(np.average(np.arange(side.size), weights=side)) for side in (apart.sum(1), apart.sum(0))
    )
    assert row == pytest.approx(2.5 * 16, abs=10)
    assert column == pytest.approx(3.5 * 16, abs=10)


def test_weights_are_kept(small: VisualCodes, tmp_path: Path) -> None:
    small.save(tmp_path, {"steps": 7})
    again = load_visual_codes(tmp_path)
    written = small.encode(picture(2))
    np.testing.assert_array_equal(again.encode(picture(2)), written)
    np.testing.assert_array_equal(again.decode(written), small.decode(written))


def test_files_that_are_none_are_refused(small: VisualCodes, tmp_path: Path) -> None:
    with pytest.raises(VisualCodesError, match="train visual-codes"):
        load_visual_codes(tmp_path)
    small.save(tmp_path, {})
    whole = (tmp_path / WEIGHTS_FILE).read_bytes()
    (tmp_path / WEIGHTS_FILE).write_bytes(whole[:-100])
    with pytest.raises(VisualCodesError, match="damaged"):
        load_visual_codes(tmp_path)
    (tmp_path / WEIGHTS_FILE).write_bytes(whole)
    save_file(load_file(tmp_path / WEIGHTS_FILE), tmp_path / WEIGHTS_FILE, metadata={"looktwice": "{}"})
    with pytest.raises(VisualCodesError, match="version None"):
        load_visual_codes(tmp_path)


def test_pictures_and_codes_of_other_sizes_are_refused(small: VisualCodes) -> None:
    with pytest.raises(VisualCodesError, match="uint8"):
        small.encode(picture(0, 168, 336))
    with pytest.raises(VisualCodesError, match="98 codes"):
        small.decode([0] * 97)
    with pytest.raises(VisualCodesError, match=r"0\.\.999"):
        small.decode([1000] * 98)


def test_encoded_pictures_are_brought_to_size() -> None:
    same = picture(0)
    np.testing.assert_array_equal(frame_of(encode_png(same)), same)
    twice = same.repeat(2, axis=0).repeat(2, axis=1)
    np.testing.assert_array_equal(frame_of(encode_png(twice)), same)
