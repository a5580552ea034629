"""What a section that only its format has says, in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

_MOST_NUMBERS: Final = 20


def section_text(name: str, values: Sequence[Any]) -> str:
    """Its name, and its values by their kind, as the inspector says them; empty where they say nothing.

    Words and numbers stand as they are, records in a line each. Long rows of numbers, such as codes, are
    counted.
    """
    said = _said(list(values)).strip()
    return f"{name.replace('_', ' ').capitalize()}: {said}" if said else ""


def _said(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name.replace('_', ' ')} {_said(inner)}" for name, inner in value.items())
    if not isinstance(value, list):
        return f"{value:g}" if isinstance(value, float) else str(value)
    if len(value) > _MOST_NUMBERS and all(isinstance(each, int | float) for each in value):
        return f"{len(value)} numbers"
    return "".join(_said(each) + ("\n" if _of_records(each) else " ") for each in value).rstrip()


def _of_records(value: Any) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and any(map(_of_records, value)))
