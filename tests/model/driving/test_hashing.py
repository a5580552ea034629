from __future__ import annotations

from model.driving.hashing import hash_of


def test_hashes_tell_parts_apart() -> None:
    assert hash_of("ab", "c") != hash_of("a", "bc") != hash_of("abc")
    assert hash_of(b"1") != hash_of("1")
    assert hash_of({"a": 1, "b": 2}) == hash_of({"b": 2, "a": 1})
