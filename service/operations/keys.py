"""Keys that open the service, of which only hashes are kept."""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Final

_LINE: Final = re.compile(r"([A-Za-z0-9._-]{1,64}):([0-9a-f]{64})")
_KEY_PREFIX: Final = "lt_"


def new_line(owner: str) -> tuple[str, str]:
    """A key of 256 random bits, and its line in a keys file; raises `ValueError` for a strange owner."""
    key = _KEY_PREFIX + secrets.token_urlsafe(32)
    line = f"{owner}:{hashed(key)}"
    if _LINE.fullmatch(line) is None:
        raise ValueError(f"{owner!r} is no name for a key's owner: letters, digits, dots, dashes, at most 64")
    return key, line


def hashed(key: str) -> str:
    """What is kept of a key. It is random, so that one round of SHA-256 is enough."""
    return hashlib.sha256(key.encode()).hexdigest()


class Keys:
    """The keys that open the service, by the names of their owners.

    Args:
        hashes: SHA-256 in hex by owner; empty opens the service to everybody.
    """

    def __init__(self, hashes: Mapping[str, str]) -> None:
        self._hashes = dict(hashes)

    @classmethod
    def read(cls, path: Path) -> Keys:
        """The keys of a file with a line ``name:sha256`` for each; raises `ValueError` with the line."""
        hashes: dict[str, str] = {}
        for number, line in enumerate(path.read_text().splitlines(), 1):
            if not line.strip() or line.startswith("#"):
                continue
            match = _LINE.fullmatch(line.strip())
            if match is None or match[1] in hashes:
                raise ValueError(
                    f"{path}, line {number}: want name:sha256-of-the-key in hex, each name once; "
                    "`looktwice keys new NAME` writes one"
                )
            hashes[match[1]] = match[2]
        if not hashes:
            raise ValueError(f"{path} holds no key; `looktwice keys new NAME` writes one")
        return cls(hashes)

    def __bool__(self) -> bool:
        return bool(self._hashes)

    def owner(self, key: str) -> str | None:
        """Whose ``key`` it is; takes as long for any other."""
        given, found = hashed(key), None
        for owner, kept in self._hashes.items():
            if hmac.compare_digest(given, kept):
                found = owner
        return found
