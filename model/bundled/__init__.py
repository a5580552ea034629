"""What comes with the package: trained checkpoints and a few test scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Final

_HERE: Final = Path(__file__).parent
CHECKPOINTS: Final = {name: _HERE / name for name in ("looktwice-nano", "elf-nano", "world-nano")}
"""Their folders, by the names that commands take; the first one is the default."""
CHECKPOINT: Final = CHECKPOINTS["looktwice-nano"]
SCENES: Final = _HERE / "scenes.parquet"
"""Labelled scenes for the demo: of validation seed 500123, and of test seeds (600000 and up)."""
