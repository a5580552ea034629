"""What else might be driven stands in the prompt, behind all that stood there before."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from looktwice.model.driving.scene import Scene
from looktwice.model.network.alternatives import ALTERNATIVES
from looktwice.model.network.checkpoint import Loaded, create_nano, load, save, with_second_sketches
from looktwice.model.network.codec import TrajectoryCodec
from looktwice.model.network.intent import INTENT_TOKENS, IntentReader
from looktwice.model.network.second_sketch import (
    LOOK_GAIN,
    VERDICT_TOKENS,
    CurveSpace,
    Known,
    SecondSketch,
)
from looktwice.model.network.vla_settings import NANO_SETTINGS, SettingsError
from looktwice.model.network.vocabulary import Vocabulary
from tests.model.network.conftest import CODEC_SIZE, made_up_scene
from tests.model.network.motions import made_up_motions

MORE = VERDICT_TOKENS + NANO_SETTINGS.sketch_tokens


@pytest.fixture(scope="module")
def before(
    small_codec: TrajectoryCodec, vocabulary: Vocabulary, tmp_path_factory: pytest.TempPathFactory
) -> Loaded:
    folder = tmp_path_factory.mktemp("before")
    settings = replace(NANO_SETTINGS, codec_size=CODEC_SIZE)
    create_nano(folder, small_codec, vocabulary, settings=settings)
    return load(folder)


@pytest.fixture(scope="module")
def loaded(before: Loaded) -> Loaded:
    return with_second_sketches(before)


def test_all_else_stays(before: Loaded, loaded: Loaded, tmp_path: Path) -> None:
    assert "second_sketch" not in before.settings.to_dict()
    assert loaded.settings.scene_queries == before.settings.scene_queries
    assert loaded.inputs.longest_prompt("cf_vla") == before.inputs.longest_prompt("cf_vla") + 2 * MORE
    save(tmp_path, loaded.model, loaded.vocabulary, loaded.codec)
    again = load(tmp_path)
    assert again.settings == loaded.settings
    state = again.model.state_dict()
    for name, value in before.model.state_dict().items():
        torch.testing.assert_close(state[name], value, rtol=0, atol=0)


def test_a_prompt_has_them_behind_the_first_sketch(before: Loaded, loaded: Loaded) -> None:
    scene = made_up_scene(3)
    with torch.inference_mode():
        one, other = (
            each.model.encode_prompt_embeddings(each.inputs.build(scene, "cf_vla")).embeddings
            for each in (before, loaded)
        )
    planners = 2 if scene.tracks is not None else 1
    assert len(other) == len(one) + MORE * planners
    # Codebooks are filled anew, in full precision. The tokens of a state tell more than they did.
    kept = [each for each in one if ((other - each).abs().amax(dim=1) < 0.05).any()]
    assert len(kept) == len(one) - INTENT_TOKENS * planners


def test_a_state_tells_whether_a_look_pays(loaded: Loaded) -> None:
    assert loaded.model.track_reader is not None
    second = loaded.model.track_reader.second
    assert second is not None
    holds = torch.tensor([[0.5, 0.9, 0.2], [0.5, 0.6, 0.1], [0.5, 0.5 + LOOK_GAIN, 0.1]])
    verdicts = torch.stack([holds, 1 - holds], dim=2).log()
    found = SecondSketch(torch.zeros(3, 20), verdicts, verdicts[:, 1:, 0].argmax(dim=1))
    with torch.inference_mode():
        told = second.doubt(found)[:, 0] @ second.pays
    assert told[0] > 0.95
    assert told[1] < -0.7
    assert abs(told[2]) < 1e-5


@pytest.mark.parametrize("by", ["facts", "tracks"])
def test_the_likeliest_alternative_is_written(loaded: Loaded, by: str) -> None:
    """Wherever the critic sees it: its vector is that of the alternative, as near as the codec comes."""
    model = loaded.model
    assert model.resampler is not None
    assert model.track_reader is not None
    reader: IntentReader = model.track_reader if by == "tracks" else model.resampler.intent
    assert reader.second is not None
    assert model.sketch_books is not None
    scene: Scene = made_up_scene(5)
    codes = model._sketch_codes()
    assert codes is not None
    assert codes.space is not None
    histories, futures = made_up_motions(6)
    histories, futures = histories.astype(np.float32), futures.astype(np.float32)
    history = torch.from_numpy(histories)
    around = {
        "facts": torch.rand(6, 60),
        "tracks": torch.rand(6, 16, 19),
    }[by]
    route = torch.from_numpy(np.stack([np.asarray(scene.route)] * 6)).float()
    known = Known(history, route, torch.ones(6, dtype=torch.bool), **{by: around})
    vectors = torch.from_numpy(loaded.codec.vectors(histories, futures))
    with torch.inference_mode():
        found = reader.second(vectors, codes.space, known)
    assert found.verdicts.shape[:2] == (6, 1 + len(ALTERNATIVES))
    torch.testing.assert_close(found.verdicts.exp().sum(dim=2), torch.ones(6, 1 + len(ALTERNATIVES)))
    likeliest = found.verdicts[:, 1:, 0].argmax(dim=1)
    assert torch.equal(found.places, likeliest)


def test_the_space_is_the_codecs(small_codec: TrajectoryCodec) -> None:
    space = CurveSpace(torch.from_numpy(small_codec.mean), torch.from_numpy(small_codec.axes))
    histories, futures = (each.astype(np.float32) for each in made_up_motions(20))
    vectors = small_codec.vectors(histories, futures)
    poses = space.poses(torch.from_numpy(vectors), torch.from_numpy(histories))
    expected = small_codec.trajectories(histories, vectors)[..., [0, 1, 3]]
    np.testing.assert_allclose(poses.numpy(), expected, atol=1e-3)
    again = space.vectors(poses, torch.from_numpy(histories))
    np.testing.assert_allclose(again.numpy(), vectors, atol=1e-2)


def test_a_second_sketch_needs_a_first_one() -> None:
    with pytest.raises(SettingsError, match="second sketch"):
        replace(NANO_SETTINGS, sketch_tokens=0, scene_tokens=18, second_sketch=True)
