"""A trie over the tokenised words of a choice."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import numpy.typing as npt


class Node:
    """A node of a trie over tokenised options.

    Attributes:
        children: by token.
        option: the position of the one that may end here.
        ids: int64 [k], the tokens, ascending.
        ranks: int64 [k], the place of each token among them by the first option that it leads to.
    """

    __slots__ = ("children", "ids", "option", "ranks")

    def __init__(self) -> None:
        self.children: dict[int, Node] = {}
        self.option: int | None = None
        self.ids: npt.NDArray[np.int64] = np.empty(0, np.int64)
        self.ranks: npt.NDArray[np.int64] = np.empty(0, np.int64)

    def options(self) -> Iterator[int]:
        """Positions of the options reachable from here."""
        if self.option is not None:
            yield self.option
        for child in self.children.values():
            yield from child.options()


def build_trie(texts: Sequence[str], encode: Callable[[str], Sequence[int]]) -> Node:
    """The trie over different ``texts``."""
    root = Node()
    for position, text in enumerate(texts):
        node = root
        for token in encode(text):
            node = node.children.setdefault(token, Node())
        node.option = position
    stack = [root]
    while stack:
        node = stack.pop()
        node.ids = np.array(sorted(node.children), np.int64)
        # Options came in order, so a token's place among the children is that of the first one it leads to.
        node.ranks = np.argsort(np.fromiter(node.children, np.int64))
        stack += node.children.values()
    return root
