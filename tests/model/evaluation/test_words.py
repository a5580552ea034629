from __future__ import annotations

import ast
from pathlib import Path

import clients.labelling.teachers.rules as rules
from model.evaluation.words import unknown_words, words_of


def test_misspelt_words_are_none() -> None:
    assert unknown_words("A M wouldoldunleff stands in my lane, some 25 metres ahead.") == [
        "m",
        "wouldoldunleff",
    ]


def test_numbers_and_times_are_no_words() -> None:
    assert words_of("Turning from 0.9s, some 25 m/s; it's the T-junction.") == [
        *("turning", "from", "some", "m", "s", "it's", "the", "t-junction")
    ]


def test_every_word_of_the_built_in_teacher_is_one() -> None:
    """The sentences that it writes; what it tells programmers is not among them."""
    tree = ast.parse(Path(rules.__file__).read_text())
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
    sentences = [
        node.value
        for function in functions
        for statement in function.body
        if not (isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant))
        for node in ast.walk(statement)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]
    names = [name for of in rules._NAMES.values() for name in of]
    assert len(sentences) > 80
    # The "s" of seconds stands behind a number that is filled in.
    assert {word for text in (*sentences, *names) for word in unknown_words(text)} <= {"s"}
