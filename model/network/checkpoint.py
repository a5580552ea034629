"""Checkpoint folders in Hugging Face layout: create, save, load, expand a stock Qwen2.5-VL.

A folder holds ``config.json``, tokenizer files, ``model.safetensors`` (or shards), the trajectory codec,
``looktwice.json``, a small card for tools, the codes of pictures where a model imagines any, and what a model
repository needs (`looktwice.model.network.repository`).
"""

from __future__ import annotations

import contextlib
import copy
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, cast

import torch
from safetensors import SafetensorError
from transformers import AutoTokenizer, Qwen2_5_VLConfig
from transformers.utils import logging as transformers_logging

from looktwice.model.families.picture_codes import VisualCodesError
from looktwice.model.network.card import (
    CheckpointError,
    read_card,
    weight_files,
    weights_revision,
    write_card,
)
from looktwice.model.network.codec import CodecError, TrajectoryCodec
from looktwice.model.network.inputs import InputBuilder
from looktwice.model.network.model_card import ModelCard
from looktwice.model.network.numbers import needed_numbers, write_number_embeddings
from looktwice.model.network.repository import write_repository
from looktwice.model.network.visual_codes import WEIGHTS_FILE as VISUAL_CODES_FILE
from looktwice.model.network.visual_codes import VisualCodes, load_visual_codes
from looktwice.model.network.vla import (
    LookTwiceVla,
    VlaConfig,
    nano_config,
    padded_size,
    parameters_of,
    with_settings,
)
from looktwice.model.network.vla_settings import SettingsError, VlaSettings
from looktwice.model.network.vocabulary import Vocabulary, VocabularyError, add_numbers, expand_tokenizer

_PUBLISHED_NAMES: Final = {
    r"^visual\.": "model.visual.",
    r"^model\.(?!language_model\.|visual\.)": "model.language_model.",
}
"""Names of weights as Qwen published them, and what `transformers` calls them now. It knows this by the
name of its own class only, so a subclass has to say it."""


@dataclass(frozen=True, eq=False)
class Parts:
    """What surrounds a checkpoint's network.

    Attributes:
        vocabulary: its tokenizer.
        codec: its trajectory codec.
        inputs: builds its inputs.
        card: what it is, for people; ``engine`` is ``torch``.
        visual_codes: its codes of pictures, where it has any.
    """

    vocabulary: Vocabulary
    codec: TrajectoryCodec
    inputs: InputBuilder
    card: ModelCard
    visual_codes: VisualCodes | None = field(default=None, kw_only=True)

    @property
    def settings(self) -> VlaSettings:
        """Cameras, sizes and formats."""
        return self.inputs.settings


@dataclass(frozen=True, eq=False)
class Loaded(Parts):
    """A checkpoint in memory: ``model`` is the network, in evaluation mode."""

    model: LookTwiceVla


def create_nano(
    folder: Path,
    codec: TrajectoryCodec,
    vocabulary: Vocabulary,
    seed: int = 0,
    settings: VlaSettings | None = None,
) -> None:
    """Write an untrained nano checkpoint; ``seed`` decides its weights.

    Raises:
        CheckpointError: codec and vocabulary have different numbers of codes.
    """
    _check_sizes(codec, vocabulary)
    config = nano_config(vocabulary, settings)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        model = LookTwiceVla(config)
        write_code_embeddings(model, codec, vocabulary)
        write_number_embeddings(model, vocabulary, set(needed_numbers(model.settings)))
    if model.sketch_books is not None:
        model.sketch_books.fill(codec)
    save(folder, model, vocabulary, codec)


def save(
    folder: Path,
    model: LookTwiceVla,
    vocabulary: Vocabulary,
    codec: TrajectoryCodec,
    *,
    dtype: torch.dtype | None = None,
    details: Mapping[str, Any] | None = None,
    visual_codes: VisualCodes | None = None,
) -> None:
    """Write a checkpoint folder.

    Args:
        folder: made when missing; files of an earlier save are replaced.
        model, vocabulary, codec: its parts.
        dtype: of the stored weights but for the books of sketches; None keeps the model's. bfloat16 halves
            the file.
        details: anything worth showing on the card, JSON-like (recipe, steps, figures).
        visual_codes: of pictures, for models that imagine.
    """
    folder.mkdir(parents=True, exist_ok=True)
    state = model.state_dict()
    if dtype is not None:
        # Sketches are told by the nearest code: rounded books would change a token in one of nine.
        state = {
            name: value.to(dtype)
            if value.is_floating_point() and not name.startswith("sketch_books.")
            else value
            for name, value in state.items()
        }
    before = model.config.dtype
    model.config.dtype = dtype or before
    try:
        with without_progress_bars():
            model.save_pretrained(folder, state_dict=state)
    finally:
        model.config.dtype = before
    for weights in folder.glob("model*.safetensors"):
        # safetensors writes files that nobody but their owner can read: a service may be somebody else.
        shutil.copymode(folder / "config.json", weights)
    vocabulary.tokenizer.save_pretrained(folder)
    codec.save(folder)
    if visual_codes is not None:
        visual_codes.save(folder, visual_codes.details)
    else:
        (folder / VISUAL_CODES_FILE).unlink(missing_ok=True)
    write_card(folder, model.settings, parameters_of(model), details or {})
    write_repository(folder)


def load(folder: Path, dtype: torch.dtype = torch.float32, device: str = "cpu") -> Loaded:
    """Read a checkpoint folder; nothing is downloaded.

    Raises:
        CheckpointError: the folder or one of its parts is missing or does not fit; says which.
    """
    parts = read_parts(folder)
    network: Any = _load_model(folder, read_config(folder), dtype)
    return Loaded(**vars(parts), model=network.to(device).eval())


def read_parts(folder: Path) -> Parts:
    """Read a checkpoint folder but for its weights.

    Raises:
        CheckpointError: a part is missing or does not fit; says which.
    """
    card = read_card(folder)
    config = read_config(folder)
    try:
        vocabulary = Vocabulary(AutoTokenizer.from_pretrained(folder, local_files_only=True))
        codec = TrajectoryCodec.load(folder)
        settings = VlaSettings.of_config(config)
        has_visual = (folder / VISUAL_CODES_FILE).is_file()
        visual_codes = load_visual_codes(folder) if has_visual else None
    except (VocabularyError, CodecError, SettingsError, VisualCodesError) as error:
        raise CheckpointError(f"{folder}: {error}") from error
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{folder}: its tokenizer cannot be loaded: {error}") from error
    _check_sizes(codec, vocabulary)
    inputs = InputBuilder(vocabulary, settings, visual_codes)
    return Parts(
        vocabulary=vocabulary,
        codec=codec,
        inputs=inputs,
        card=ModelCard(
            name=card["name"],
            revision=weights_revision(folder),
            engine="torch",
            formats=settings.formats,
            cameras=settings.cameras,
            image_size=(settings.image_width, settings.image_height),
            parameters=card["parameters"],
            inputs=settings.inputs,
            paints=visual_codes is not None,
            details=card["details"],
        ),
        visual_codes=visual_codes,
    )


def expand_stock(
    source: Path,
    target: Path,
    codec: TrajectoryCodec,
    settings: VlaSettings,
    *,
    seed: int = 0,
    dtype: torch.dtype = torch.bfloat16,
) -> None:
    """Turn a stock Qwen2.5-VL checkpoint folder into a LookTwice checkpoint, ready to be trained.

    Markers and codes are added to its tokenizer, embeddings grow where its spare rows do not suffice, and
    the encoders start at random. Pictures' patch sizes follow the stock configuration.

    Args:
        source: a folder as Qwen publishes it.
        target: where the new checkpoint goes; not ``source``.
        codec: decides the number of codes.
        settings: name, cameras, picture size, formats; what must agree with the backbone is overwritten.
        seed: of the new weights.
        dtype: of the stored weights.

    Raises:
        CheckpointError: ``source`` is no Qwen2.5-VL checkpoint; says what is missing.
    """
    if source.resolve() == target.resolve():
        raise CheckpointError("the expanded checkpoint must go to another folder than the stock one")
    config = read_config(source)
    vision = config.vision_config
    try:
        tokenizer = AutoTokenizer.from_pretrained(source, local_files_only=True)
        expand_tokenizer(tokenizer, codec.size)
        add_numbers(tokenizer, needed_numbers(settings))
        vocabulary = Vocabulary(tokenizer)
        fitted = replace(
            settings,
            codec_size=codec.size,
            patch_size=vision.patch_size,
            temporal_patch_size=vision.temporal_patch_size,
            spatial_merge_size=vision.spatial_merge_size,
            tokens_per_second=vision.tokens_per_second,
        )
    except (VocabularyError, SettingsError) as error:
        raise CheckpointError(f"{source}: {error}") from error
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{source}: its tokenizer cannot be loaded: {error}") from error
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        model = _load_model(source, with_settings(config, fitted, vocabulary), dtype, new_encoders=True)
        rows = max(padded_size(vocabulary), config.text_config.vocab_size)
        model.resize_token_embeddings(rows, mean_resizing=False)
        write_code_embeddings(model, codec, vocabulary)
        write_number_embeddings(model, vocabulary, set(needed_numbers(fitted)))
    save(target, model, vocabulary, codec, details={"expanded_from": source.name})


def with_formats(loaded: Loaded, formats: Sequence[str], *, seed: int = 0) -> Loaded:
    """A checkpoint that may write more response formats, to be trained on them; changed in place.

    Numbers that they write as tokens are added to its tokenizer, behind all others: what it writes in its own
    formats stays the same to the token.

    Args:
        loaded: the checkpoint.
        formats: beside its own.
        seed: of the new weights.

    Raises:
        FamilyError: there is no such format.
    """
    settings = replace(loaded.settings, formats=tuple(dict.fromkeys((*loaded.settings.formats, *formats))))
    vocabulary, model = loaded.vocabulary, loaded.model
    sizes = needed_numbers(settings)
    if new := set(sizes) - set(vocabulary.alphabets):
        add_numbers(vocabulary.tokenizer, sizes)
        vocabulary = Vocabulary(vocabulary.tokenizer)
        embeddings: Any = model.get_input_embeddings()
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            rows = max(padded_size(vocabulary), len(embeddings.weight))
            model.resize_token_embeddings(rows, mean_resizing=False)
            write_number_embeddings(model, vocabulary, new)
    with_settings(model.config, settings, vocabulary)
    return replace(
        loaded,
        vocabulary=vocabulary,
        inputs=InputBuilder(vocabulary, settings, loaded.visual_codes),
        card=replace(loaded.card, formats=settings.formats),
    )


def with_sketches(loaded: Loaded, stages: int, *, seed: int = 0) -> Loaded:
    """A checkpoint whose small planners write sketches of so many codes, to be trained.

    Args:
        loaded: one that writes none, or sketches of fewer codes; it stays as it is.
        stages: at most 6.
        seed: of the new weights.
    """
    return _with_intents(loaded, seed, sketch_tokens=stages)


def with_second_sketches(loaded: Loaded, *, seed: int = 0) -> Loaded:
    """A checkpoint whose prompt also tells what else might be driven, to be trained.

    Args:
        loaded: one that writes sketches; it stays as it is.
        seed: of the new weights.
    """
    return _with_intents(loaded, seed, second_sketch=True)


def with_fine_vision(loaded: Loaded, *, seed: int = 0) -> Loaded:
    """A checkpoint with convolutions beside its tower, to be trained.

    Args:
        loaded: one with a resampler, and without them; it stays as it is.
        seed: of the new weights.
    """
    settings = replace(loaded.settings, fine_vision=True)
    model = _made(loaded, settings, seed)
    assert model.resampler is not None
    assert model.fine_vision is not None
    model.resampler.fine_layer.hush()
    model.fine_vision.expect_nobody()
    model.load_state_dict(loaded.model.state_dict(), strict=False)
    model.train(False)
    return replace(loaded, model=model, inputs=InputBuilder(loaded.vocabulary, settings, loaded.visual_codes))


def _made(loaded: Loaded, settings: VlaSettings, seed: int) -> LookTwiceVla:
    """A network of other settings, all its weights new."""
    config = with_settings(copy.deepcopy(loaded.model.config), settings, loaded.vocabulary)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return LookTwiceVla(config)


def _with_intents(loaded: Loaded, seed: int, **changes: Any) -> Loaded:
    """A checkpoint with more tokens of an intent, as many queries of its resampler, and its own weights."""
    # An intent's tokens are some of a scene's: as long as there are too few of these, settings are refused.
    resampled = loaded.settings.scene_tokens
    wider = replace(loaded.settings, scene_tokens=2 * resampled, **changes)
    more = wider.intent_tokens - loaded.settings.intent_tokens
    wider = replace(wider, scene_tokens=resampled + more if resampled else 0)
    model = _made(loaded, wider, seed)
    # Books of fewer codes are none of these, and all are the codec's.
    kept = {name: value for name, value in loaded.model.state_dict().items() if "sketch_books" not in name}
    model.load_state_dict(kept, strict=False)
    assert model.sketch_books is not None
    model.sketch_books.fill(loaded.codec)
    model.train(False)
    inputs = InputBuilder(loaded.vocabulary, wider, loaded.visual_codes)
    return replace(loaded, model=model, inputs=inputs)


def with_visual_codes(loaded: Loaded, codes: VisualCodes) -> Loaded:
    """A checkpoint with other codes of pictures, or with its first ones."""
    inputs = InputBuilder(loaded.vocabulary, loaded.settings, codes)
    return replace(loaded, inputs=inputs, visual_codes=codes, card=replace(loaded.card, paints=True))


@torch.no_grad()
def write_code_embeddings(model: LookTwiceVla, codec: TrajectoryCodec, vocabulary: Vocabulary) -> None:
    """Set the embeddings of trajectory codes from the codebook, so that near codes begin near.

    A random projection of the code's vector, scaled per stage to the spread of the embeddings that are
    there; each stage has a direction of its own besides. Draws from torch's global random state.
    """
    network: Any = model
    for layer in (network.get_input_embeddings(), network.get_output_embeddings()):
        weight = layer.weight
        spread = float(weight[: vocabulary.code_ids(0).start].float().std())
        vectors = torch.from_numpy(codec.code_vectors())
        projection = torch.randn(vectors.shape[-1], weight.shape[1])
        for stage, words in enumerate(vectors):
            projected = words @ projection
            scaled = projected / projected.std().clamp_min(1e-6) + 0.5 * torch.randn(weight.shape[1])
            ids = vocabulary.code_ids(stage)
            weight[ids.start : ids.stop] = (spread * scaled / scaled.std()).to(weight.dtype)


def read_config(folder: Path) -> VlaConfig:
    """The configuration of a folder's network; raises `CheckpointError`."""
    path = folder / "config.json"
    if not path.is_file():
        raise CheckpointError(f"{folder} has no config.json")
    try:
        kind = json.loads(path.read_text(encoding="utf-8")).get("model_type")
        if kind != Qwen2_5_VLConfig.model_type:
            raise CheckpointError(f"{path} describes a {kind!r} model, not {Qwen2_5_VLConfig.model_type!r}")
        return Qwen2_5_VLConfig.from_pretrained(folder, local_files_only=True)
    except (json.JSONDecodeError, OSError) as error:
        raise CheckpointError(f"{path} is damaged: {error}") from error


def _load_model(
    folder: Path, config: VlaConfig, dtype: torch.dtype, *, new_encoders: bool = False
) -> LookTwiceVla:
    weight_files(folder)
    try:
        with without_progress_bars():
            loader: Any = LookTwiceVla
            model, report = loader.from_pretrained(
                folder,
                config=config,
                dtype=dtype,
                key_mapping=_PUBLISHED_NAMES,
                local_files_only=True,
                output_loading_info=True,
            )
    except (OSError, ValueError, RuntimeError, SafetensorError) as error:
        raise CheckpointError(f"{folder}: its weights cannot be loaded: {error}") from error
    absent = [
        name
        for name in sorted(report["missing_keys"])
        if not (new_encoders and name.startswith(("history_encoder.", "route_encoder.")))
    ]
    if absent:
        raise CheckpointError(f"{folder}: its weights lack {', '.join(absent[:5])} ({len(absent)} in all)")
    return cast("LookTwiceVla", model)


@contextlib.contextmanager
def without_progress_bars() -> Iterator[None]:
    """A service's log is no place for them."""
    logging: Any = transformers_logging
    shown = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        if shown:
            logging.enable_progress_bar()


def _check_sizes(codec: TrajectoryCodec, vocabulary: Vocabulary) -> None:
    if codec.size != vocabulary.codec_size:
        raise CheckpointError(
            f"the codec has {codec.size} codes per stage, the vocabulary {vocabulary.codec_size}"
        )
