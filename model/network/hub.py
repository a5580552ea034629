"""Checkpoints by their name on the Hugging Face hub."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

from looktwice.model.network.card import CheckpointError

_NAME: Final = re.compile(r"[\w.-]+/[\w.-]+(@[\w./-]+)?")
_FILES: Final = ("*.json", "*.safetensors", "*.jinja", "*.md", "*.txt")
"""What a checkpoint takes. Code is not among it: ours comes with this package."""


def checkpoint_folder(named: Path) -> Path:
    """The folder of a checkpoint: ``named`` itself, or where the hub's repository of that name was put.

    Args:
        named: a folder, or ``OWNER/NAME`` on the hub, with ``@REVISION`` behind it for another than the
            newest. What exists here comes first.

    Raises:
        CheckpointError: there is neither; says why the hub did not give it.
    """
    name = str(named)
    if named.exists() or not _NAME.fullmatch(name) or name.startswith("."):
        return named
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

    name, _, revision = name.partition("@")
    try:
        return Path(snapshot_download(name, revision=revision or None, allow_patterns=list(_FILES)))
    except LocalEntryNotFoundError:
        reason = "the hub cannot be reached, and nothing of that name was downloaded before"
    except (HfHubHTTPError, HFValidationError, OSError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
    raise CheckpointError(f"there is no folder {named}, and no such model on the Hugging Face hub: {reason}")
