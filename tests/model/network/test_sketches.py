from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from looktwice.model.network.checkpoint import (
    Loaded,
    create_nano,
    load,
    save,
    with_second_sketches,
    with_sketches,
)
from looktwice.model.network.codec import DIMENSIONS, TrajectoryCodec
from looktwice.model.network.intent import INTENT_TOKENS, SketchBooks, SketchCodes
from looktwice.model.network.track_features import TRACK_FEATURES
from looktwice.model.network.trajectory_head import spread_of
from looktwice.model.network.vla_settings import NANO_SETTINGS, SettingsError, VlaSettings
from looktwice.model.network.vocabulary import Vocabulary
from tests.model.network.conftest import CODEC_SIZE
from tests.model.network.motions import made_up_motions

STAGES = 3


@pytest.fixture(scope="module")
def codes(small_codec: TrajectoryCodec) -> SketchCodes:
    """Of which each embedding is its code's vector: a mixture then says where it is."""
    books = SketchBooks(STAGES, CODEC_SIZE)
    books.fill(small_codec)
    vectors = books.books.detach()
    return SketchCodes(vectors, books.widths.detach(), vectors)


def sketches_of(codec: TrajectoryCodec, count: int, seed: int = 0) -> Tensor:
    vectors = torch.from_numpy(codec.vectors(*made_up_motions(count, seed)))
    return vectors / spread_of(torch.from_numpy(codec.books[0]))


def test_a_sketch_comes_nearer_with_every_token(codes: SketchCodes, small_codec: TrajectoryCodec) -> None:
    sketches = sketches_of(small_codec, 200, seed=1)
    tokens = codes.tokens(sketches).detach()
    assert tokens.shape == (200, STAGES, DIMENSIONS)
    vectors = sketches * spread_of(codes.books[0])
    left = [float((vectors - tokens[:, :count].sum(dim=1)).norm(dim=1).mean()) for count in range(STAGES + 1)]
    assert left == sorted(left, reverse=True)
    assert left[-1] < 0.5 * left[0]


def test_tokens_are_the_codes_that_a_trajectory_is_written_in(
    codes: SketchCodes, small_codec: TrajectoryCodec
) -> None:
    """Code by code, each the nearest to what is left: else there would be nothing to copy."""
    rest = small_codec.vectors(*made_up_motions(200, seed=1))
    one_each = codes._replace(embeddings=torch.eye(CODEC_SIZE).expand(STAGES, -1, -1))
    tokens = one_each.tokens(sketches_of(small_codec, 200, seed=1))
    torch.testing.assert_close(tokens.sum(dim=2), torch.ones(200, STAGES))
    shares = tokens.numpy()
    for stage, book in enumerate(small_codec.books[:STAGES]):
        nearest = np.linalg.norm(rest[:, None] - book, axis=2).argmin(axis=1)
        same = shares[:, stage].argmax(axis=1) == nearest
        # Where a token mixes two codes, the next one has what is left of the mixture.
        assert same.all() if stage == 0 else np.mean(same) > 0.9
        assert np.mean(shares[:, stage].max(axis=1)) > 0.9
        rest -= book[nearest]


def test_rounding_changes_tokens_hardly_ever(codes: SketchCodes, small_codec: TrajectoryCodec) -> None:
    """Somewhere between two trajectories the nearest code changes from one to the other.

    There a token mixes both, and what is left for the next one moves with the mixture: the first token moves
    no more than its sketch does, and later ones only in one sketch of thousands.
    """
    random = np.random.default_rng(0)
    ends = sketches_of(small_codec, 400)
    one, other = (ends[random.integers(0, len(ends), 40_000)] for _ in range(2))
    sketches = torch.lerp(one, other, torch.from_numpy(random.random((40_000, 1), np.float32)))
    moved = (codes.tokens(sketches + 1e-6) - codes.tokens(sketches)).abs().amax(dim=2)
    bound = 0.05 * float(codes.books[0].std())
    assert float(moved[:, 0].max()) < bound
    assert float((moved.amax(dim=1) > bound).float().mean()) < 1e-3


def test_small_planners_get_sketches_and_all_else_stays(
    small_codec: TrajectoryCodec, vocabulary: Vocabulary, tmp_path: Path
) -> None:
    settings = replace(
        NANO_SETTINGS,
        codec_size=CODEC_SIZE,
        sketch_tokens=0,
        scene_tokens=NANO_SETTINGS.scene_tokens - NANO_SETTINGS.sketch_tokens,
    )
    create_nano(tmp_path / "before", small_codec, vocabulary, settings=settings)
    before = load(tmp_path / "before")
    assert "sketch_tokens" not in before.settings.to_dict()
    stages = NANO_SETTINGS.sketch_tokens
    wider = with_sketches(before, stages)
    assert wider.settings == replace(NANO_SETTINGS, codec_size=CODEC_SIZE)
    assert wider.settings.intent_tokens == INTENT_TOKENS + stages
    assert wider.inputs.longest_prompt("cf_vla") == before.inputs.longest_prompt("cf_vla") + 2 * stages
    save(tmp_path / "wider", wider.model, wider.vocabulary, wider.codec)
    again = load(tmp_path / "wider")
    assert again.settings == wider.settings
    state = again.model.state_dict()
    new = set(state) - set(before.model.state_dict())
    assert new == {
        "sketch_books.books",
        "sketch_books.widths",
        *(
            f"{part}.sketch.{each}"
            for part in ("track_reader", "resampler.intent")
            for each in ("weight", "bias")
        ),
    }
    for name, value in before.model.state_dict().items():
        torch.testing.assert_close(state[name], value, rtol=0, atol=0)
    np.testing.assert_array_equal(state["sketch_books.books"].numpy(), small_codec.books[:stages])


def test_sketches_of_fewer_codes_are_told_in_more_and_all_else_stays(
    small_codec: TrajectoryCodec, vocabulary: Vocabulary, tmp_path: Path
) -> None:
    fewer = NANO_SETTINGS.sketch_tokens - STAGES
    settings = replace(
        NANO_SETTINGS,
        codec_size=CODEC_SIZE,
        sketch_tokens=STAGES,
        scene_tokens=NANO_SETTINGS.scene_tokens - fewer,
    )
    create_nano(tmp_path / "before", small_codec, vocabulary, settings=settings)
    before = with_second_sketches(load(tmp_path / "before"))
    wider = with_sketches(before, STAGES + fewer)
    assert wider.settings.scene_queries == before.settings.scene_queries
    assert wider.settings.intent_tokens == before.settings.intent_tokens + 2 * fewer
    state = wider.model.state_dict()
    for name, value in before.model.state_dict().items():
        if not name.startswith("sketch_books."):
            torch.testing.assert_close(state[name], value, rtol=0, atol=0)
    books = small_codec.books[: STAGES + fewer]
    np.testing.assert_array_equal(state["sketch_books.books"].numpy(), books)


def test_a_sketch_is_told_in_the_decoders_own_codes(
    small_codec: TrajectoryCodec, vocabulary: Vocabulary, tmp_path: Path
) -> None:
    settings = replace(NANO_SETTINGS, codec_size=CODEC_SIZE)
    create_nano(tmp_path, small_codec, vocabulary, settings=settings)
    loaded = load(tmp_path)
    reader = loaded.model.track_reader
    assert reader is not None
    assert reader.sketch is not None
    assert loaded.model.sketch_books is not None
    code = 5
    with torch.no_grad():
        reader.sketch.weight.zero_()
        reader.sketch.bias.copy_(torch.from_numpy(small_codec.books[0, code]) / loaded_spread(loaded))
        loaded.model.sketch_books.widths.fill_(1e-3)
        embeddings = loaded.model.embed(
            torch.tensor([[loaded.model.track_token_id] * settings.intent_tokens]),
            history=torch.zeros(1, 16, 4),
            tracks=torch.zeros(1, 16, len(TRACK_FEATURES)),
        )
        expected = loaded.model.get_input_embeddings()(torch.tensor(vocabulary.code_ids(0)[code]))
    torch.testing.assert_close(embeddings[0, INTENT_TOKENS], expected)


def loaded_spread(loaded: Loaded) -> Tensor:
    return spread_of(torch.from_numpy(loaded.codec.books[0]))


def test_more_sketch_tokens_than_codes_are_refused() -> None:
    with pytest.raises(SettingsError, match="sketch_tokens"):
        VlaSettings(sketch_tokens=7)


def test_a_codec_of_another_space_makes_no_sketches(small_codec: TrajectoryCodec) -> None:
    narrow = TrajectoryCodec(small_codec.mean, small_codec.axes[:7], small_codec.books[..., :7])
    with pytest.raises(ValueError, match="7"):
        SketchBooks(STAGES, CODEC_SIZE).fill(narrow)
