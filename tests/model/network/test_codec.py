from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load_file, save_file

from looktwice.model.driving.trajectory import STEP_S, present_speed
from looktwice.model.network import quantiser
from looktwice.model.network.codec import CODEC_FILE, HEADING_WEIGHT_M, CodecError, TrajectoryCodec
from looktwice.model.network.splines import clamped_basis
from tests.comma2k19 import windows
from tests.model.network.motions import made_up_motions

SMALL = TrajectoryCodec.fit(*made_up_motions(1500), size=32, seed=1)
MIRROR = np.array([1, -1, 1, -1], np.float32)


@given(st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_decoding_what_was_encoded_comes_close(seed: int) -> None:
    histories, futures = made_up_motions(8, seed)
    codes = SMALL.encode(histories, futures)
    assert codes.shape == (8, 6)
    assert codes.dtype == np.int64
    assert codes.min() >= 0
    assert codes.max() < 32
    decoded = SMALL.decode(histories, codes)
    assert decoded.shape == (8, 64, 4)
    assert decoded.dtype == np.float32
    assert not decoded[..., 2].any()
    apart = np.linalg.norm(decoded[..., :2] - futures[..., :2], axis=-1).mean(axis=1)
    assert apart.mean() < 1.5, "32 codes a stage are coarse, but not that coarse"


@given(st.lists(st.integers(0, 31), min_size=6, max_size=6), st.integers(0, 1000))
@settings(deadline=None)
def test_any_codes_begin_at_the_present_without_a_jump(codes: list[int], seed: int) -> None:
    histories, _ = made_up_motions(1, seed)
    first = SMALL.decode(histories, [codes])[0, 0]
    jump = np.hypot(first[0] - present_speed(histories[0]) * STEP_S, first[1])
    # 0.1 s at a most extreme 30 m/s^2 from a standing start would be 0.15 m.
    assert jump < 0.3


def test_mirrored_motions_are_met_as_well() -> None:
    histories, futures = made_up_motions(300, seed=77)
    plain = SMALL.reconstruction_error(histories, futures)
    mirrored = SMALL.reconstruction_error(histories * MIRROR, futures * MIRROR)
    assert mirrored["ade_m"] == pytest.approx(plain["ade_m"], rel=0.15)


def test_larger_codebooks_err_less() -> None:
    train, seen_not = made_up_motions(1500, seed=2), made_up_motions(300, seed=3)
    errors = [
        TrajectoryCodec.fit(*train, size=size).reconstruction_error(*seen_not)["ade_m"]
        for size in (8, 32, 64)
    ]
    assert errors[0] > 1.2 * errors[1] > 1.3 * errors[2]
    assert errors[2] < 0.5


def test_the_same_seed_gives_the_same_codec() -> None:
    train = made_up_motions(300)
    one, other = (TrajectoryCodec.fit(*train, size=8, seed=5) for _ in range(2))
    np.testing.assert_array_equal(one.books, other.books)
    assert not np.array_equal(one.books, TrajectoryCodec.fit(*train, size=8, seed=6).books)


def test_standstill_stays_put() -> None:
    histories, futures = np.zeros((1, 16, 4), np.float32), np.zeros((1, 64, 4), np.float32)
    decoded = SMALL.decode(histories, SMALL.encode(histories, futures))
    assert np.abs(decoded[..., :2]).max() < 1.0


def test_headings_beyond_half_a_turn() -> None:
    """Wrapped headings (as to_ego_frame gives them) are the same motion."""
    histories, futures = made_up_motions(50, seed=9)
    wrapped = futures.copy()
    wrapped[..., 3] = (wrapped[..., 3] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_array_equal(SMALL.encode(histories, wrapped), SMALL.encode(histories, futures))


def test_code_vectors_are_metres() -> None:
    vectors = SMALL.code_vectors()
    assert vectors.shape[:2] == (6, 32)
    history = np.zeros((1, 16, 4), np.float32)
    # Two codes of the first stage differ by what their vectors say, in root mean square metres.
    one, other = (SMALL.decode(history, [[code, 0, 0, 0, 0, 0]])[0] for code in (0, 1))
    squares = ((one - other)[:, :2] ** 2).sum(axis=1) + (HEADING_WEIGHT_M * (one - other)[:, 3]) ** 2
    expected = np.linalg.norm(vectors[0, 0] - vectors[0, 1])
    assert np.sqrt(squares.mean()) == pytest.approx(float(expected), rel=1e-3)


def test_saved_and_loaded(tmp_path: Path) -> None:
    SMALL.save(tmp_path)
    again = TrajectoryCodec.load(tmp_path)
    histories, futures = made_up_motions(20, seed=4)
    np.testing.assert_array_equal(again.encode(histories, futures), SMALL.encode(histories, futures))


def test_unusable_files(tmp_path: Path) -> None:
    with pytest.raises(CodecError, match="has no trajectory_codec"):
        TrajectoryCodec.load(tmp_path)
    SMALL.save(tmp_path)
    tensors = load_file(tmp_path / CODEC_FILE)
    save_file(tensors, tmp_path / CODEC_FILE, metadata={"looktwice": json.dumps({"version": 7})})
    with pytest.raises(CodecError, match="version 7"):
        TrajectoryCodec.load(tmp_path)
    del tensors["books"]
    save_file(tensors, tmp_path / CODEC_FILE, metadata={"looktwice": json.dumps({"version": 1})})
    with pytest.raises(CodecError, match="damaged"):
        TrajectoryCodec.load(tmp_path)
    (tmp_path / CODEC_FILE).write_bytes(b"nothing")
    with pytest.raises(CodecError, match="damaged"):
        TrajectoryCodec.load(tmp_path)


@pytest.mark.parametrize("codes", [[[0, 0, 0, 0, 0, 32]], [[-1, 0, 0, 0, 0, 0]]])
def test_codes_out_of_range(codes: list[list[int]]) -> None:
    with pytest.raises(CodecError, match=r"0\.\.31"):
        SMALL.decode(np.zeros((1, 16, 4), np.float32), codes)


def test_nothing_to_encode() -> None:
    empty = SMALL.encode(np.zeros((0, 16, 4), np.float32), np.zeros((0, 64, 4), np.float32))
    assert empty.shape == (0, 6)


def test_beam_search_against_every_combination() -> None:
    random = np.random.default_rng(0)
    books = random.normal(size=(2, 5, 3)).astype(np.float32)
    vectors = random.normal(size=(40, 3)).astype(np.float32)
    sums = books[0][:, None] + books[1]
    distance = np.linalg.norm(vectors[:, None, None] - sums, axis=-1).reshape(40, -1)
    best = np.stack(np.unravel_index(distance.argmin(axis=1), (5, 5)), axis=1)
    np.testing.assert_array_equal(quantiser.encode(vectors, books, beam=5), best)


def test_splines_begin_as_they_must() -> None:
    knots = np.array([0.0, 1.0, 2.5, 6.4])
    near: npt.NDArray[np.float64] = np.array([0.0, 1e-6, 3.0, 6.4])
    basis = clamped_basis(near, knots)
    np.testing.assert_allclose(basis.sum(axis=1), 1, atol=1e-12)
    slopes = (basis[1] - basis[0]) / 1e-6
    np.testing.assert_allclose(basis[0, 1:], 0, atol=1e-12)
    np.testing.assert_allclose(slopes[2:], 0, atol=1e-5)
    assert basis[3, -1] == pytest.approx(1)


def test_a_real_minute_of_driving() -> None:
    """What was learned from made-up motions writes real ones."""
    histories, futures = windows(every=10)
    codec = TrajectoryCodec.fit(*made_up_motions(3000, seed=6), size=64)
    error = codec.reconstruction_error(histories, futures)
    assert error["ade_m"] < 0.25
    assert error["fde_m"] < 0.5
    assert error["max_jump_m"] < 0.05
