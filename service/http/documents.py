"""Bodies in JSON and msgpack as plain values, with bounds on what they may hold.

A small body can be made to cost much: a million unknown keys are a million complaints, a million empty maps a
gigabyte. What no request needs is refused while it is read, before anything looks at what it means.
"""

from __future__ import annotations

import json
from typing import Any, Final

import msgpack

from looktwice.service.problems import BODY_TOO_LARGE, INVALID_BODY, INVALID_JSON, ProblemError

MAX_VALUES: Final = 250_000
"""Numbers, texts, lists and objects together: a batch of 64 scenes has 30,000, a label's annotations of a
large junction 60,000."""
MAX_MEMBERS: Final = 100
"""Of one object; the contract's largest has 15."""
MAX_OBJECTS: Final = 10_000
"""A batch of 64 scenes with all their tracks has 1,700."""
MAX_KEY_CHARACTERS: Final = 200
_PIECE_BYTES: Final = 500_000
_MAX_ITEMS: Final = 10_000
"""Of one list in msgpack, which cannot be counted before it is read."""


def read_json(body: bytes) -> Any:
    """A JSON text's value; raises `ProblemError` where it is none, or holds too much."""
    _check_values(body)
    try:
        return json.loads(body, object_pairs_hook=_Objects().read)
    except json.JSONDecodeError as error:
        raise ProblemError(INVALID_JSON, f"not JSON at character {error.pos}: {error.msg}") from None
    except (ValueError, RecursionError) as error:  # of the encoding, of a long number; nested too deeply
        raise ProblemError(INVALID_JSON, f"not JSON: {error}") from None


def read_msgpack(body: bytes) -> Any:
    """A msgpack document's value, of JSON's types and bytes; raises `ProblemError` as `read_json` does."""
    counted = _Lists()
    try:
        return msgpack.unpackb(
            body,
            ext_hook=_no_extension,
            object_pairs_hook=_Objects().read,
            list_hook=counted.read,
            max_array_len=_MAX_ITEMS,
            max_map_len=MAX_MEMBERS,
        )
    except (ValueError, msgpack.UnpackException) as error:
        raise ProblemError(INVALID_BODY, f"not msgpack: {error or type(error).__name__}") from None


def _check_values(body: bytes) -> None:
    values = 0
    # In pieces: nobody else gets to run while one is counted, and most of a body that is refused is not.
    for start in range(0, len(body), _PIECE_BYTES):
        piece = body[start : start + _PIECE_BYTES]
        # Every value but the first of its list or object follows one of these, or begins with it.
        values += sum(piece.count(mark) for mark in (b",", b"[", b"{"))
        if values > MAX_VALUES:
            raise _too_many(f"{MAX_VALUES} values")


class _Objects:
    """Makes objects of their members, so many of them."""

    def __init__(self) -> None:
        self._made = 0

    def read(self, members: list[tuple[Any, Any]]) -> dict[Any, Any]:
        self._made += 1
        if self._made > MAX_OBJECTS:
            raise _too_many(f"{MAX_OBJECTS} objects")
        if len(members) > MAX_MEMBERS:
            raise _too_many(f"{MAX_MEMBERS} members of an object")
        for key, _ in members:
            if len(key) > MAX_KEY_CHARACTERS:
                raise _too_many(f"{MAX_KEY_CHARACTERS} characters of a member's name")
        return dict(members)


class _Lists:
    """Counts what lists hold."""

    def __init__(self) -> None:
        self._values = 0

    def read(self, values: list[Any]) -> list[Any]:
        self._values += len(values) + 1
        if self._values > MAX_VALUES:
            raise _too_many(f"{MAX_VALUES} values")
        return values


def _too_many(what: str) -> ProblemError:
    return ProblemError(BODY_TOO_LARGE, f"at most {what} are accepted")


def _no_extension(code: int, _: bytes) -> Any:
    raise ValueError(f"extension type {code} is not taken here")
