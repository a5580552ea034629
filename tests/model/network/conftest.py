from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from looktwice.model.driving.images import encode_jpeg
from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE, Clip, Scene
from looktwice.model.network.checkpoint import Loaded, create_nano, load
from looktwice.model.network.codec import TrajectoryCodec
from looktwice.model.network.nano_corpus import nano_corpus
from looktwice.model.network.vocabulary import Vocabulary, build_nano_tokenizer
from tests.model.network.motions import made_up_motions

CODEC_SIZE = 16


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def vocabulary() -> Vocabulary:
    return Vocabulary(build_nano_tokenizer(nano_corpus(), CODEC_SIZE))


@pytest.fixture(scope="session")
def small_codec() -> TrajectoryCodec:
    return TrajectoryCodec.fit(*made_up_motions(400), size=CODEC_SIZE)


@pytest.fixture(scope="session")
def nano_folder(
    tmp_path_factory: pytest.TempPathFactory, vocabulary: Vocabulary, small_codec: TrajectoryCodec
) -> Path:
    folder = tmp_path_factory.mktemp("nano")
    create_nano(folder, small_codec, vocabulary, seed=3)
    return folder


@pytest.fixture(scope="session")
def nano64(nano_folder: Path) -> Loaded:
    """The nano checkpoint in float64, where different orders of summation agree."""
    return load(nano_folder, dtype=torch.float64)


@pytest.fixture(scope="session")
def scene() -> Scene:
    return made_up_scene(seed=0)


def made_up_scene(seed: int, *, route: bool = True) -> Scene:
    random = np.random.default_rng(seed)
    history, _ = made_up_motions(1, seed)

    def clip(camera: str) -> Clip:
        images = tuple(encode_jpeg(random.integers(0, 255, (112, 224, 3), np.uint8)) for _ in range(4))
        return Clip(camera, images)

    way = np.stack([np.arange(4, 84, 4), np.zeros(20)], axis=1).astype(np.float32)
    clips = (clip(FRONT_TELE), clip(FRONT_WIDE))
    return Scene(f"scene-{seed}", clips, history[0], way if route else None)
