"""The bytes that tokens stand for."""

from __future__ import annotations

from typing import Final


def byte_level(token: str) -> bytes:
    """The bytes of a token that is spelt as GPT-2 spells bytes; raises `KeyError` for any other."""
    return bytes(_BYTE_OF[character] for character in token)


def is_text(spelt: bytes, *, multiline: bool) -> bool:
    """Whether bytes are printable UTF-8 on their own, of one line or, with ``multiline``, of several."""
    try:
        text = spelt.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return (text.replace("\n", "") if multiline else text).isprintable()


def _byte_of_character() -> dict[str, int]:
    """GPT-2's spelling of bytes: printable Latin-1 as itself, the others from U+0100 on."""
    printable = [*range(0x21, 0x7F), *range(0xA1, 0xAD), *range(0xAE, 0x100)]
    hidden = [byte for byte in range(256) if byte not in printable]
    return {chr(byte): byte for byte in printable} | {
        chr(0x100 + place): byte for place, byte in enumerate(hidden)
    }


_BYTE_OF: Final = _byte_of_character()
