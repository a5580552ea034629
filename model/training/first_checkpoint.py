"""Checkpoints to begin with: a nano network, or a stock backbone that is expanded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from looktwice.model.network.checkpoint import create_nano, expand_stock
from looktwice.model.network.codec import TrajectoryCodec
from looktwice.model.network.nano_corpus import nano_corpus, nano_phrases
from looktwice.model.network.vla_settings import EXPANDED_SETTINGS, NANO_SETTINGS
from looktwice.model.network.vocabulary import Vocabulary, build_nano_tokenizer
from looktwice.model.training.examples import load_examples


def create(
    scenes: Path,
    cache: Path,
    target: Path,
    backbone: Path | None = None,
    *,
    codec_size: int = 512,
    seed: int = 0,
) -> dict[str, float]:
    """Write a checkpoint to begin with, whose codec is fitted to ``scenes``; returns the codec's error.

    Args:
        scenes: file or folder of training scenes.
        cache: for scenes brought into arrays.
        target: checkpoint folder to write.
        backbone: a stock Qwen2.5-VL folder, which is expanded; without one a nano network is made.
        codec_size: trajectory codes a stage.
        seed: of the codec and of new weights.

    Raises:
        CheckpointError: ``backbone`` is no Qwen2.5-VL.
    """
    examples = load_examples(scenes, cache, NANO_SETTINGS.cameras)
    codec = TrajectoryCodec.fit(examples.history, examples.future, size=codec_size, seed=seed)
    if backbone is not None:
        expand_stock(backbone, target, codec, replace(EXPANDED_SETTINGS, name=target.name), seed=seed)
    else:
        vocabulary = Vocabulary(build_nano_tokenizer(nano_corpus(), codec_size, phrases=nano_phrases()))
        create_nano(target, codec, vocabulary, seed, replace(NANO_SETTINGS, codec_size=codec_size))
    return codec.reconstruction_error(examples.history, examples.future)
