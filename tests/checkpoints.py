"""A small untrained checkpoint for tests: the nano network with fewer layers and a tiny codec."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from looktwice.model.driving.images import encode_jpeg
from looktwice.model.driving.scene import CLIP_FRAMES, FRONT_TELE, FRONT_WIDE, Clip, Scene, Track
from looktwice.model.families.picture_codes import PICTURE
from looktwice.model.network.checkpoint import Loaded, load, save, write_code_embeddings
from looktwice.model.network.codec import TrajectoryCodec
from looktwice.model.network.nano_corpus import nano_corpus, nano_phrases
from looktwice.model.network.numbers import needed_numbers, write_number_embeddings
from looktwice.model.network.small_planner import SmallPlanner
from looktwice.model.network.vla import LookTwiceVla, nano_config
from looktwice.model.network.vla_settings import VlaSettings
from looktwice.model.network.vocabulary import Vocabulary, build_nano_tokenizer
from tests.model.network.motions import made_up_motions

CODEC_SIZE = 16


def write_untrained(folder: Path, *, narrow: bool = False, settings: VlaSettings = VlaSettings()) -> Path:
    """Write the checkpoint and return its folder.

    Args:
        folder: to write to.
        narrow: a quarter of the width, and prone to end tracks and texts, for tests of many thousand
            responses.
        settings: cameras, pictures, and how they reach the decoder.
    """
    histories, futures = made_up_motions(400)
    codec = TrajectoryCodec.fit(histories, futures, size=CODEC_SIZE)
    numbers = needed_numbers(settings)
    tokenizer = build_nano_tokenizer(nano_corpus(), CODEC_SIZE, phrases=nano_phrases(), numbers=numbers)
    vocabulary = Vocabulary(tokenizer)
    config = nano_config(vocabulary, replace(settings, codec_size=CODEC_SIZE))
    config.text_config.num_hidden_layers = 2
    config.text_config.layer_types = config.text_config.layer_types[:2]
    config.vision_config.depth = 1
    if narrow:
        text, vision = config.text_config, config.vision_config
        text.hidden_size, text.intermediate_size = text.hidden_size // 4, text.intermediate_size // 4
        text.rope_parameters["mrope_section"] = [each // 4 for each in text.rope_parameters["mrope_section"]]
        vision.hidden_size, vision.intermediate_size = vision.hidden_size // 4, vision.intermediate_size // 4
        vision.out_hidden_size = text.hidden_size
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = LookTwiceVla(config)
        write_code_embeddings(model, codec, vocabulary)
        write_number_embeddings(model, vocabulary, set(numbers))
        if narrow:
            network: Any = model
            embeddings = network.get_input_embeddings().weight.detach()
            for text in ("6.4", "\n"):
                embeddings[vocabulary.encode(text)[0]] *= 6
    save(folder, model, vocabulary, codec)
    return folder


def write_blind(folder: Path, seed: int) -> Path:
    """Write a small planner that knows nothing, another one for each seed; returns its folder."""
    codec = TrajectoryCodec.fit(*made_up_motions(400), size=CODEC_SIZE)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        planner = SmallPlanner("blind", codec)
        torch.nn.init.normal_(planner.head.best.weight, std=0.1)
    planner.save(folder, {})
    return folder


def shake(model: LookTwiceVla) -> None:
    """Change all weights of a network a little, in place."""
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(1)
        for weight in model.parameters():
            weight.add_(torch.randn_like(weight) * weight.std(unbiased=False), alpha=0.1)


def copy_picture_codes(loaded: Loaded) -> None:
    """Change a network so that it mostly writes the code of a picture once more that it has just read."""
    network: Any = loaded.model
    ids = loaded.vocabulary.alphabets[PICTURE][0]
    with torch.no_grad():
        embeddings = network.get_input_embeddings().weight
        random = torch.randn(
            (len(ids), embeddings.shape[1]), dtype=embeddings.dtype, generator=torch.manual_seed(0)
        )
        embeddings[ids.start : ids.stop] = 0.12 * random


def write_shaken(folder: Path, source: Path) -> Path:
    """Write a checkpoint that is the same as another one but for its weights; returns its folder."""
    loaded = load(source)
    shake(loaded.model)
    save(folder, loaded.model, loaded.vocabulary, loaded.codec, visual_codes=loaded.visual_codes)
    return folder


def noisy_scene(seed: int = 0, *, route: bool = False) -> Scene:
    """A scene with random pictures and a plausible history."""
    random = np.random.default_rng(seed)
    histories, _ = made_up_motions(1, seed)
    clips = tuple(
        Clip(
            camera,
            tuple(encode_jpeg(random.integers(0, 256, (112, 224, 3), np.uint8)) for _ in range(CLIP_FRAMES)),
        )
        for camera in (FRONT_WIDE, FRONT_TELE)
    )
    way = np.stack([np.arange(4.0, 84.0, 4.0), random.normal(0, 1, 20)], axis=1) if route else None
    return Scene(f"noisy-{seed}", clips, histories[0], None if way is None else way.astype(np.float32))


def made_up_tracks(count: int, seed: int = 0) -> tuple[Track, ...]:
    """Tracked vehicles somewhere around."""
    random = np.random.default_rng(seed)
    return tuple(
        Track(float(x), float(y), float(heading), float(speed), 4.5, 1.9, "vehicle")
        for x, y, heading, speed in random.normal(size=(count, 4)) * [30, 4, 0.2, 8]
    )
