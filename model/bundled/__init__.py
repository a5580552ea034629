"""What comes with the package: the nano checkpoint and a few test scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Final

CHECKPOINT: Final = Path(__file__).parent / "looktwice-nano"
"""The default checkpoint's folder."""
SCENES: Final = Path(__file__).parent / "scenes.parquet"
"""Labelled test scenes for the demo (simulator seeds 600000 and up)."""
