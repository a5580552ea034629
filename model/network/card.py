"""The card of a checkpoint folder: ``looktwice.json``, for people and tools."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from looktwice.model.network.codec import CODEC_FILE
from looktwice.model.network.vla_settings import VlaSettings

CARD_FILE: Final = "looktwice.json"
LOG_FILE: Final = "log.jsonl"
"""Beside it: how a trained checkpoint was learned, all stages, a row of JSON each."""
CARD_VERSION: Final = 1


class CheckpointError(ValueError):
    """A folder that is not a usable checkpoint; the text says what is missing."""


def write_card(folder: Path, settings: VlaSettings, parameters: int, details: Mapping[str, Any]) -> None:
    """Write the card of a folder whose weights, codec and codes of pictures are there already."""
    card = {
        "version": CARD_VERSION,
        "name": settings.name,
        "revision": weights_revision(folder),
        "formats": list(settings.formats),
        "cameras": list(settings.cameras),
        "image_size": [settings.image_width, settings.image_height],
        "parameters": parameters,
        "details": dict(details),
    }
    (folder / CARD_FILE).write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")


def update_card(folder: Path, settings: VlaSettings, details: Mapping[str, Any]) -> dict[str, Any]:
    """Renew a card's name, formats and revision, add to what it tells beside the weights, and return it.

    Raises:
        CheckpointError: as `read_card` and `weights_revision` do.
    """
    card = read_card(folder)
    card |= {"name": settings.name, "formats": list(settings.formats)}
    card["details"] |= details
    card["revision"] = weights_revision(folder)
    (folder / CARD_FILE).write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")
    return card


def read_card(folder: Path) -> dict[str, Any]:
    """The card of a folder, with at least ``name``, ``revision``, ``parameters`` and ``details``.

    Raises:
        CheckpointError: missing, damaged or of another version.
    """
    path = folder / CARD_FILE
    if not path.is_file():
        raise CheckpointError(f"{folder} is not a LookTwice checkpoint: it has no {CARD_FILE}")
    try:
        card: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CheckpointError(f"{path} is damaged: {error}") from error
    if card.get("version") != CARD_VERSION:
        raise CheckpointError(
            f"{path} has version {card.get('version')}; this LookTwice reads version {CARD_VERSION}"
        )
    if missing := {"name", "revision", "parameters", "details"} - card.keys():
        raise CheckpointError(f"{path} lacks {', '.join(sorted(missing))}")
    return card


def is_foreign(folder: Path) -> bool:
    """Whether a folder is a checkpoint for `transformers` that LookTwice did not write."""
    return (folder / "config.json").is_file() and not (folder / CARD_FILE).is_file()


def weight_files(folder: Path) -> list[Path]:
    """The files with a folder's weights, one or several shards; raises `CheckpointError` for none."""
    files = sorted(folder.glob("model*.safetensors"))
    if not files:
        raise CheckpointError(f"{folder} has no model.safetensors")
    return files


def weights_revision(folder: Path) -> str:
    """12 hexadecimal digits that change with the weights: the network's, the codec's, those of picture codes.

    Raises:
        CheckpointError: the network's or the codec's are missing.
    """
    # Who only reads cards needs no torch.
    from looktwice.model.network.visual_codes import WEIGHTS_FILE

    if not (folder / CODEC_FILE).is_file():
        raise CheckpointError(f"{folder} has no {CODEC_FILE}")
    parts = [folder / CODEC_FILE, folder / WEIGHTS_FILE]
    return files_revision([*weight_files(folder), *(path for path in parts if path.is_file())])


def files_revision(paths: Iterable[Path]) -> str:
    """12 hexadecimal digits of SHA-256 over the names, sizes and contents of files, in this order."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(f"{path.name} {path.stat().st_size}\n".encode())
        with path.open("rb") as file:
            while block := file.read(1 << 22):
                digest.update(block)
    return digest.hexdigest()[:12]
