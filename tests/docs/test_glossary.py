"""Modules and classes are called by the words of docs/glossary.md, not by those that it avoids."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

from tests.test_architecture import ROOT, modules

OTHER_SENSES = frozenset(
    {
        # What the glossary says itself in another row, such as a teacher, a lane or a reason.
        *("action", "control", "draft", "failure", "lane", "reason", "rollout", "row", "teacher"),
        # The field's words, and those of programming languages.
        *("accuracy", "agents", "annotation", "cache", "case", "command", "error", "fault", "frame"),
        *("generation", "grammar", "job", "node", "page", "phase", "run", "runner", "sample", "sampling"),
        *("score", "sequence", "timeout", "verdict", "waypoints"),
        # Words of others: the OpenAI API's completion, NAVSIM's past motion, a tensor's layout.
        *("block", "completion", "layout", "past"),
        # Parts of other words: a labeller writes plans from trajectories, a load test warms up.
        *("labeller", "offline", "up"),
        # Positions, in a picture or a text; ways through a format or a batch; parts of a checkpoint.
        *("path", "place", "places", "way", "parts"),
    }
)
"""Words that are to be avoided for one thing and are right for another."""


def avoided() -> set[str]:
    """Single words of the glossary's last column."""
    rows = [line.strip("|").split("|") for line in (ROOT / "docs/glossary.md").read_text().splitlines()]
    columns = [re.sub(r"\([^)]*\)", "", row[2]) for row in rows if len(row) == 3]
    words = {word.strip().lower() for column in columns for word in column.split(",")}
    return {word for word in words if word.isalpha()} - {"avoid"}


def names() -> Iterator[tuple[str, str]]:
    """Every module and class with the module that it stands in."""
    for module, path in modules():
        yield module, module.rpartition(".")[2]
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                yield module, node.name


def words_of(name: str) -> set[str]:
    """The words that a name is made of, in the plural and the singular: `KvRows` is of kv, rows and row."""
    words = {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)}
    return words | {word.removesuffix("s") for word in words}


def test_names_use_no_word_that_the_glossary_avoids() -> None:
    found = {(module, name): words_of(name) & (avoided() - OTHER_SENSES) for module, name in names()}
    assert {each: words for each, words in found.items() if words} == {}


def test_words_with_another_sense_are_avoided_and_used() -> None:
    used = {word for _, name in names() for word in words_of(name)}
    assert OTHER_SENSES - avoided() == set()
    assert OTHER_SENSES - used == set()
