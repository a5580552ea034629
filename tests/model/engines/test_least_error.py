from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.engines.engine import Controls
from looktwice.model.engines.least_error import Expected, LeastError, least_error
from looktwice.model.engines.sampling import probabilities
from looktwice.model.engines.torch.decoder import Decoder
from looktwice.model.engines.torch.runner import Runner
from looktwice.model.families.picture_codes import levels_of
from looktwice.model.formats.cursor import Allowed
from looktwice.model.network.checkpoint import Loaded, load
from tests.checkpoints import noisy_scene
from tests.model.engines.decoding import decode, request
from tests.model.engines.reference import reference_draws


@pytest.fixture(scope="module")
def loaded(untrained_checkpoint: Path) -> Loaded:
    return load(untrained_checkpoint)


@pytest.fixture(scope="module")
def least(loaded: Loaded) -> LeastError:
    return LeastError(loaded.codec, loaded.vocabulary)


def test_distances_are_those_of_trajectories(loaded: Loaded) -> None:
    codec = loaded.codec
    history = noisy_scene(0).history
    one, other = codec.decode(history[None].repeat(2, axis=0), [[3, 0, 0, 0, 0, 0], [7, 0, 0, 0, 0, 0]])
    apart = one - other
    squares = apart[:, 0] ** 2 + apart[:, 1] ** 2 + (apart[:, 3] * 4.5 / 3) ** 2
    told = codec.code_distances_m()[0]
    assert told[3, 7] == pytest.approx(np.sqrt(squares.mean()), rel=0.05)
    assert told[3, 3] == 0


@given(st.integers(0, 5), st.integers(0, 2**32 - 1))
def test_no_other_code_is_expected_to_be_off_less(
    loaded: Loaded, least: LeastError, stage: int, seed: int
) -> None:
    random = np.random.default_rng(seed)
    logits = 3 * random.normal(size=loaded.codec.size)
    left = random.random(len(logits)) < 0.5
    left[0] = True
    distances = loaded.codec.code_distances_m()[stage]
    place = least_error(logits, codes_expected(loaded, least, stage), left)
    assert left[place]
    believed = probabilities(logits[left])
    expected = distances[left][:, left] @ believed
    assert believed @ distances[left, place] == pytest.approx(expected.min(), abs=1e-6)


def codes_expected(loaded: Loaded, least: LeastError, stage: int) -> Expected:
    allowed = Allowed(np.array(loaded.vocabulary.code_ids(stage)), "trajectory")
    assert least.expected(allowed, Controls(codes="drawn")) is None
    expected = least.expected(allowed, Controls(numbers="drawn"))
    assert expected is not None
    return expected


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 20.0))
def test_no_other_picture_is_expected_to_be_off_less(painting: LeastError, seed: int, sharp: float) -> None:
    random = np.random.default_rng(seed)
    logits, left = sharp * random.normal(size=1000), random.random(1000) < 0.5
    left[0] = True
    allowed = Allowed(np.arange(5000, 6000), "visual")
    assert painting.expected(allowed, Controls(codes="drawn")) is None
    expected = painting.expected(allowed, Controls())
    assert expected is not None
    place = least_error(logits, expected, left)
    assert left[place]
    levels = levels_of(np.arange(1000))
    placed = levels / np.array([7, 4, 4, 4])
    believed = probabilities(logits[left])
    off = np.abs(placed[:, None] - placed[left]).sum(axis=-1) @ believed
    assert off[place] == pytest.approx(off[left].min())
    # Where all may be chosen, that is each level's median.
    for number, chosen in enumerate(levels[least_error(logits, expected)]):
        share = np.bincount(levels[:, number], probabilities(logits))
        assert share[:chosen].sum() <= 0.5 + 1e-9
        assert share[: chosen + 1].sum() >= 0.5 - 1e-9


@pytest.fixture(scope="module")
def painting(loaded: Loaded) -> LeastError:
    """Of a tokenizer that has codes of pictures, too."""

    class Painting:
        alphabets: Final = {"visual": (range(5000, 6000),)}
        code_ids = staticmethod(loaded.vocabulary.code_ids)

    return LeastError(loaded.codec, Painting())


def test_words_are_drawn(loaded: Loaded, least: LeastError) -> None:
    for ids in (np.array(loaded.vocabulary.code_ids(0)[:2]), np.arange(loaded.codec.size)):
        assert least.expected(Allowed(ids, "plan"), Controls()) is None


@given(st.integers(0, 2**32 - 1), st.integers(2, 12))
def test_no_other_number_is_expected_to_be_off_less(least: LeastError, seed: int, count: int) -> None:
    random = np.random.default_rng(seed)
    logits, ranks = 3 * random.normal(size=count), random.permutation(count)
    left = random.random(count) < 0.5
    left[0] = True
    allowed = Allowed(np.arange(count), "plan", ranks=ranks)
    assert least.expected(allowed, Controls(numbers="drawn")) is None
    expected = least.expected(allowed, Controls(codes="drawn"))
    assert expected is not None
    place = least_error(logits, expected, left)
    assert left[place]
    believed = probabilities(np.where(left, logits, -np.inf))
    errors = np.abs(ranks[:, None] - ranks) @ believed
    assert expected(believed) == pytest.approx(errors)
    assert errors[place] == pytest.approx(errors[left].min())


@pytest.mark.usefixtures("inference")
def test_draws_with_one_plan_end_alike_unless_codes_are_drawn(exact: Loaded) -> None:
    asked = request("least", 1, "traj_only", n=4)
    draws = decode(Decoder(Runner(exact, 8)), asked, request("drawn", 1, "traj_only", n=4, codes="drawn"))
    least = [draws["least", index].codes for index in range(4)]
    assert len(set(least)) == 1
    assert least == [draw.codes for draw in reference_draws(exact, asked)]
    assert len({draws["drawn", index].codes for index in range(4)}) > 1
