"""Foreign checkpoints: what `transformers` loads and LookTwice did not write.

They are asked in their own way, by their own chat template and picture processor, and write the formats of
families whose responses are words and numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from safetensors import SafetensorError
from transformers import (
    MODEL_FOR_CAUSAL_LM_MAPPING,
    MODEL_FOR_IMAGE_TEXT_TO_TEXT_MAPPING,
    AutoConfig,
    AutoModelForCausalLM,
    AutoModelForImageTextToText,
    AutoProcessor,
    AutoTokenizer,
)

from looktwice.model.families.family import Family
from looktwice.model.families.registry import OURS, families_of
from looktwice.model.formats.contents import contents
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.formats.pieces import Codes, FormatError
from looktwice.model.network.card import CheckpointError, files_revision, is_foreign, weight_files
from looktwice.model.network.checkpoint import without_progress_bars
from looktwice.model.network.foreign_inputs import ForeignInputBuilder
from looktwice.model.network.foreign_prompt import PICTURES
from looktwice.model.network.foreign_vocabulary import ForeignVocabulary
from looktwice.model.network.model_card import ModelCard
from looktwice.model.network.vocabulary import VocabularyError
from looktwice.model.network.weights import refuse_differing, sizes_of

_LOCAL: Final[dict[str, Any]] = {"local_files_only": True, "trust_remote_code": False}


@dataclass(frozen=True, eq=False)
class ForeignCheckpoint:
    """A foreign checkpoint in memory.

    Attributes:
        model: the network, in evaluation mode.
        vocabulary: of its tokenizer.
        families: that it is to write, by name.
        formats: of these, over its tokens.
        inputs: makes its prompts.
        card: what it is called, and what it is given.
    """

    model: Any
    vocabulary: ForeignVocabulary
    families: dict[str, Family]
    formats: dict[str, CompiledFormat]
    inputs: ForeignInputBuilder
    card: ModelCard


def load_foreign(folder: Path, formats: Sequence[str], dtype: torch.dtype) -> ForeignCheckpoint:
    """Read a foreign checkpoint; nothing is downloaded, and no code in the folder is run.

    Args:
        folder: as `transformers` saves it: configuration, weights as safetensors, tokenizer, processor.
        formats: that it is to write, the default first.
        dtype: of the network.

    Raises:
        CheckpointError: a part is missing or cannot be loaded, it writes no text, or cannot write a format.
        FamilyError: there is no such format.
    """
    if not formats:
        raise CheckpointError(
            f"{folder} is no LookTwice checkpoint, so it does not say what it writes; "
            f"name a response format with --format, such as {_in_words()}"
        )
    families = families_of(formats, "free_text")
    for family in families.values():
        if codes := _alphabets(family):
            raise CheckpointError(
                f"{folder} cannot write format {family.name!r}: its responses hold codes "
                f"({', '.join(codes)}) that only LookTwice checkpoints have; without are {_in_words()}"
            )
    try:
        config = AutoConfig.from_pretrained(folder, **_LOCAL)
        sees = type(config) in MODEL_FOR_IMAGE_TEXT_TO_TEXT_MAPPING
        if not sees and type(config) not in MODEL_FOR_CAUSAL_LM_MAPPING:
            raise CheckpointError(f"a {config.model_type!r} model writes no responses to text")
        loader: Any = AutoProcessor if sees else AutoTokenizer
        processor = loader.from_pretrained(folder, **_LOCAL)
        vocabulary = ForeignVocabulary(processor.tokenizer if sees else processor)
        cameras = PICTURES.cameras if sees else ()
        inputs = ForeignInputBuilder(processor, vocabulary, families, cameras)
        if sees and inputs.chat_template is None:
            raise CheckpointError("it has no chat template, which says where pictures stand")
        compiled = {name: CompiledFormat(family.format, vocabulary) for name, family in families.items()}
        model = _load_model(folder, AutoModelForImageTextToText if sees else AutoModelForCausalLM, dtype)
    except (VocabularyError, FormatError, CheckpointError) as error:
        raise CheckpointError(f"{folder} cannot be served: {error}") from error
    except (
        OSError,
        ValueError,
        KeyError,
        ImportError,
        RuntimeError,
        AttributeError,
        SafetensorError,
    ) as error:
        raise CheckpointError(f"{folder} cannot be loaded by transformers: {error}") from error
    rows = model.get_input_embeddings().weight.shape[0]
    if len(vocabulary) > rows:
        raise CheckpointError(f"{folder}: its tokenizer has {len(vocabulary)} tokens, its network {rows}")
    card = ModelCard(
        name=_name(folder),
        revision=files_revision(weight_files(folder)),
        engine="transformers",
        formats=tuple(families),
        cameras=cameras,
        image_size=(PICTURES.image_width, PICTURES.image_height),
        parameters=model.num_parameters(),
        inputs=("route", "tracks"),
        deadlines=False,
        details={
            "model_type": config.model_type,
            "pictures": "by its own processor" if sees else "none",
        },
    )
    return ForeignCheckpoint(model, vocabulary, families, compiled, inputs, card)


def load_foreign_weights(mine: ForeignCheckpoint, folder: Path) -> ModelCard:
    """Write the weights of another foreign checkpoint into a network, in place, and return its card.

    Raises:
        CheckpointError: the folder is no usable checkpoint, or differs in more than its weights.
    """
    if not is_foreign(folder):
        raise CheckpointError(f"{folder} is no checkpoint of the kind that runs; start an engine over it")
    other = load_foreign(folder, tuple(mine.families), mine.model.dtype)
    same = {
        "tokenizer": mine.vocabulary.spellings == other.vocabulary.spellings,
        "chat template": mine.inputs.chat_template == other.inputs.chat_template,
        "network": sizes_of(mine.model.config.to_dict()) == sizes_of(other.model.config.to_dict()),
    }
    refuse_differing(same, folder)
    mine.model.load_state_dict(other.model.state_dict())
    return other.card


def _load_model(folder: Path, auto: Any, dtype: torch.dtype) -> Any:
    weight_files(folder)
    with without_progress_bars():
        model, report = auto.from_pretrained(folder, dtype=dtype, output_loading_info=True, **_LOCAL)
    if absent := sorted(report["missing_keys"]):
        raise CheckpointError(f"its weights lack {', '.join(absent[:5])} ({len(absent)} in all)")
    return model.eval()


def _alphabets(family: Family) -> list[str]:
    """The alphabets of codes that a family's prompts and responses need."""
    bodies = [family.format.body, *([] if family.inputs is None else [family.inputs.format.body])]
    pieces = (piece for body in bodies for piece in contents(body))
    return sorted({piece.alphabet for piece in pieces if isinstance(piece, Codes)})


def _in_words() -> str:
    """Which of our formats need no codes."""
    return ", ".join(
        name for name, family in families_of(OURS, "free_text").items() if not _alphabets(family)
    )


def _name(folder: Path) -> str:
    """What a checkpoint is called: its folder, or its name on the hub where it was downloaded from there."""
    whole = folder.resolve()
    if whole.parent.name == "snapshots":
        return whole.parent.parent.name.removeprefix("models--").replace("--", "/")
    return whole.name
