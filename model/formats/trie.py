"""A trie over the tokenised words of a choice."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import numpy.typing as npt

from model.formats.pieces import FormatError


class Node:
    """A node of a trie over tokenised options."""

    __slots__ = ("children", "ids", "option")

    def __init__(self) -> None:
        self.children: dict[int, Node] = {}
        self.option: int | None = None
        self.ids: npt.NDArray[np.int64] = np.empty(0, np.int64)

    def options(self) -> Iterator[int]:
        """Positions of the options reachable from here."""
        if self.option is not None:
            yield self.option
        for child in self.children.values():
            yield from child.options()


def build_trie(texts: Sequence[str], encode: Callable[[str], Sequence[int]]) -> Node:
    """The trie over ``texts``; leaves know the position of their text.

    Raises:
        FormatError: a text's tokens begin another's, so that where it ends could not be told.
    """
    root = Node()
    for position, text in enumerate(texts):
        node = root
        for token in encode(text):
            if node.option is not None:
                raise FormatError(f"option {texts[node.option]!r} is a beginning of {text!r} in tokens")
            node = node.children.setdefault(token, Node())
        if node.children or node.option is not None:
            raise FormatError(f"option {text!r} is a beginning of another option in tokens")
        node.option = position
    stack = [root]
    while stack:
        node = stack.pop()
        node.ids = np.array(sorted(node.children), np.int64)
        stack += node.children.values()
    return root
