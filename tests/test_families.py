"""Only a family's own folder names its sections and words; everybody else asks the family."""

from __future__ import annotations

import ast
from collections.abc import Iterator

from looktwice.model.families.cf_vla import CF_VLA
from looktwice.model.families.elf_vla import ELF_VLA
from looktwice.model.families.vla_world import VLA_WORLD
from tests.test_architecture import ROOT, modules

assert CF_VLA.branch is not None
SECTIONS = frozenset(CF_VLA.format.sections())
BRANCH_WORDS = (CF_VLA.branch.direct, CF_VLA.branch.reflecting)
HOME = "model/families/cf_vla/"
ROOMS = ("model/", "service/")
"""Where responses are known: others only know the HTTP contract."""

OTHERWISE = {
    # Fields, events and words of the HTTP contract, which is CF-VLA's for all families.
    "clients/wire/plan.py": 4,
    "service/cli/plan.py": 3,
    "service/http/errors.py": 1,
    "service/routes/examples.py": 2,
    "service/operations/metrics.py": 3,
    "service/routes/chat.py": 1,
    "service/planning/telling.py": 5,
    # Controls and columns of tables.
    "model/bench/report.py": 3,
    "service/cli/bench.py": 1,
    # Commands, routes and kinds of work.
    "service/cli/commands.py": 1,
    "service/cli/loadtest.py": 1,
    "service/planning/submitting.py": 1,
    # Records of draws.
    "model/driving/feedback_store.py": 1,
    "model/driving/trajectory.py": 1,
    "model/evaluation/draw_store.py": 9,
    "model/evaluation/pictures.py": 1,
    # The alphabet of trajectory codes.
    "model/families/trajectory_codes.py": 1,
}
"""Where the same words mean something else, and how often. No file writes CF-VLA's texts itself."""


def literals(source: str) -> Iterator[str]:
    """The texts in a module, those that stand alone (docstrings) apart."""
    tree = ast.parse(source)
    alone = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in alone:
            yield node.value


def named(source: str, sections: frozenset[str] = SECTIONS) -> int:
    """How often a module names one of some sections, or writes a word of the branch."""
    return sum(text in sections or any(word in text for word in BRANCH_WORDS) for text in literals(source))


def test_nobody_else_names_sections_and_branch_words() -> None:
    counts: dict[str, int] = {}
    for _, path in modules():
        place = str(path.relative_to(ROOT))
        if not place.startswith(HOME):
            counts[place] = named(path.read_text(), SECTIONS if place.startswith(ROOMS) else frozenset())
    assert {path: count for path, count in counts.items() if count} == OTHERWISE


ELF_VLA_WORDS = ("<think>", "</think>", "<answer>", "</answer>")


def test_nobody_else_names_sections_and_words_of_elf_vla() -> None:
    sections = frozenset(ELF_VLA.format.sections())
    found = {
        str(path.relative_to(ROOT)): text
        for _, path in modules()
        if (room := str(path.relative_to(ROOT))).startswith(ROOMS)
        # Families that look like it have sections of the same names.
        and not room.startswith(("model/families/elf_vla/", "model/families/vla_world/"))
        for text in literals(path.read_text())
        if text in sections or any(word in text for word in ELF_VLA_WORDS)
    }
    # What a branch of CF-VLA's is counted as; a field of the HTTP contract of feedback.
    assert found == {"service/operations/metrics.py": "think", "service/routes/examples.py": "think"}


def test_nobody_else_writes_the_tags_of_vla_world() -> None:
    tags = tuple(f"{start}{section}>" for section in VLA_WORLD.format.sections() for start in ("<", "</"))
    found = {
        str(path.relative_to(ROOT))
        for _, path in modules()
        if not str(path.relative_to(ROOT)).startswith(
            ("model/families/elf_vla/", "model/families/vla_world/")
        )
        for text in literals(path.read_text())
        if any(tag in text for tag in tags)
    }
    assert found == set()


def test_literals_are_counted_and_docstrings_are_not() -> None:
    assert named('"""Thinking: it over."""\nsection = "revised_plan"\nplan = thinking\n') == 1
    assert named('text = f"Thinking: {it} over"\n') == 1
