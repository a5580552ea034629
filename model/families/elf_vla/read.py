"""What a response of ELF-VLA says."""

from __future__ import annotations

from looktwice.model.families.elf_vla.format import ANSWER, read_poses
from looktwice.model.families.family import Decode, Reading
from looktwice.model.formats.pieces import Values


def read(values: Values, decode: Decode) -> Reading:
    """Its poses. Nothing is decoded: there are no codes."""
    return Reading(read_poses(values[ANSWER]))
