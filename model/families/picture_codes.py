"""A picture as codes: what every family that imagines pictures writes them in."""

from __future__ import annotations

from typing import Final

PICTURE: Final = "visual"
"""The alphabet of picture codes."""
PICTURE_CODES: Final = 98
"""Of a picture; `looktwice.model.network.visual_codes` makes them."""
PICTURE_CODEBOOK: Final = 1000
"""How many different codes there are."""
