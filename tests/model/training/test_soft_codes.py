from __future__ import annotations

import numpy as np
import pytest

from looktwice.model.network.codec import TrajectoryCodec
from looktwice.model.training.soft_codes import SoftCodes
from tests.model.network.motions import made_up_motions


@pytest.fixture(scope="module")
def fitted() -> tuple[TrajectoryCodec, np.ndarray]:
    histories, futures = made_up_motions(600)
    codec = TrajectoryCodec.fit(histories, futures, size=32)
    return codec, codec.vectors(histories, futures)


def test_drawn_codes_spell_the_trajectory_about_as_well_as_the_best_ones(
    fitted: tuple[TrajectoryCodec, np.ndarray],
) -> None:
    codec, vectors = fitted
    soft, random = SoftCodes(codec, vectors), np.random.default_rng(0)
    stages = np.arange(len(codec.books))
    rest = [
        np.linalg.norm(vector - codec.books[stages, soft.draw(vector, random).codes].sum(axis=0))
        for vector in vectors[:200]
    ]
    untouched = np.linalg.norm(vectors[:200], axis=1)
    assert np.median(rest) < 0.15 * np.median(untouched)


def test_shares_are_distributions_that_favour_the_nearest(
    fitted: tuple[TrajectoryCodec, np.ndarray],
) -> None:
    codec, vectors = fitted
    soft, random = SoftCodes(codec, vectors), np.random.default_rng(0)
    for vector in vectors[:20]:
        shares = soft.draw(vector, random).shares
        assert np.allclose(shares.sum(axis=1), 1, atol=1e-5)
        nearest = ((codec.books[0] - vector) ** 2).sum(axis=1).argmin()
        assert shares[0].argmax() == nearest
        effective = np.exp(-(shares * np.log(shares + 1e-12)).sum(axis=1))
        assert effective.max() < 20


def test_draws_differ_and_are_reproducible(
    fitted: tuple[TrajectoryCodec, np.ndarray],
) -> None:
    codec, vectors = fitted
    soft = SoftCodes(codec, vectors)
    random = np.random.default_rng(1)
    drawn = {tuple(soft.draw(vectors[0], random).codes) for _ in range(20)}
    assert len(drawn) > 1
    again = np.random.default_rng(1)
    assert {tuple(soft.draw(vectors[0], again).codes) for _ in range(20)} == drawn


def test_where_asked_for_the_first_codes_are_the_nearest_and_nothing_else(
    fitted: tuple[TrajectoryCodec, np.ndarray],
) -> None:
    codec, vectors = fitted
    soft, random = SoftCodes(codec, vectors), np.random.default_rng(0)
    for vector in vectors[:20]:
        drawn = soft.draw(vector, random, nearest=3)
        rest = vector.copy()
        for book, code, shares in zip(codec.books[:3], drawn.codes, drawn.shares, strict=False):
            assert code == ((book - rest) ** 2).sum(axis=1).argmin()
            np.testing.assert_array_equal(shares, np.arange(codec.size) == code)
            rest -= book[code]
        assert (drawn.shares[3:].max(axis=1) < 1).any()
