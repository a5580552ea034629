"""Only a family's own folder names its sections and words; everybody else asks the family."""

from __future__ import annotations

import ast
import itertools
import re
from collections.abc import Iterator

from looktwice.model.families.cf_vla import CF_VLA
from looktwice.model.families.elf_vla import ELF_VLA
from looktwice.model.families.registry import OURS
from looktwice.model.families.vla_world import VLA_WORLD
from tests.test_architecture import PACKAGES, ROOT, imports, modules, place, within

assert CF_VLA.branch is not None
SECTIONS = frozenset(CF_VLA.format.sections())
BRANCH_WORDS = (CF_VLA.branch.direct, CF_VLA.branch.reflecting)
HOMES = tuple(
    home.parent.relative_to(ROOT).as_posix() for home in (ROOT / "model/families").glob("*/__init__.py")
)

OTHERWISE = {
    "clients/alpasim": ("branch plan revised_plan", "what a rollout's log tells of a draw"),
    "clients/labelling": ("plan thinking trajectory", "records in the ledger"),
    "clients/wire": ("Action: Thinking: branch plan revised_plan thinking trajectory", "the HTTP contract"),
    "loadtests": ("plan", "a kind of work, and an event"),
    "model/bench/bench_report.py": ("thinking", "a control"),
    "model/driving/trajectory.py": ("trajectory", "what an error speaks of"),
    "model/evaluation/draw_store.py": ("plan revised_plan trajectory", "fields of a draw"),
    "model/evaluation/pictures.py": ("plan", "a caption"),
    "model/families/trajectory_codes.py": ("trajectory", "an alphabet"),
    "model/training/branch.py": ("branch", "a recipe"),
    "service/cli": ("branch plan thinking trajectory", "commands, and what they print"),
    "service/http/problem_documents.py": ("plan trajectory", "fields of the HTTP contract"),
    "service/inspector": ("plan thinking", "elements of the page"),
    "service/operations/service_metrics.py": ("branch plan thinking", "labels of metrics"),
    "service/planning": ("branch plan revised_plan thinking trajectory", "endpoints and events"),
    "service/routes": ("plan thinking trajectory", "examples and events"),
}
"""Where words of CF-VLA mean something else: which, and what."""

NAMING = {
    "model/evaluation/ladder.py": "the ladder of CF-VLA's own tables",
    "model/families/registry.py": "which families there are",
    "model/training/recipes.py": "the stages that teach our families",
}
"""Who names families of ours, or imports from their folders, and why."""


def literals(source: str) -> Iterator[str]:
    """The texts in a module, those that stand alone (docstrings) apart."""
    tree = ast.parse(source)
    alone = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in alone:
            yield node.value


def script_literals(source: str) -> Iterator[str]:
    """The texts in a script of a page."""
    return itertools.chain(*re.findall(r'"([^"\n]*)"|`([^`]*)`', source))


def texts() -> Iterator[tuple[str, str]]:
    """The files of all rooms, modules and scripts, each with every text in it."""
    for package in PACKAGES:
        for suffix, read in ((".py", literals), (".js", script_literals)):
            for path in (ROOT / package).rglob(f"*{suffix}"):
                yield from ((path.relative_to(ROOT).as_posix(), text) for text in read(path.read_text()))


def named(text: str) -> set[str]:
    """What a text names: one of the sections, or words of the branch."""
    return ({text} & SECTIONS) | {word for word in BRANCH_WORDS if word in text}


def test_nobody_else_names_sections_and_branch_words() -> None:
    found: dict[str, set[str]] = {}
    for path, text in texts():
        if not within(path, ("model/families/cf_vla",)) and (words := named(text)):
            room = next((room for room in OTHERWISE if within(path, (room,))), path)
            found.setdefault(room, set()).update(words)
    assert {room: " ".join(sorted(words)) for room, words in found.items()} == {
        room: words for room, (words, _) in OTHERWISE.items()
    }


def test_nobody_else_names_a_family() -> None:
    found = {path for path, text in texts() if text in OURS and not within(path, HOMES)}
    for _, module in modules():
        path = module.relative_to(ROOT).as_posix()
        others = tuple(home for home in HOMES if not within(path, (home,)))
        if any(within(place(imported), others) for imported in imports(module)):
            found.add(path)
    assert found == NAMING.keys()


ELF_VLA_WORDS = ("<think>", "</think>", "<answer>", "</answer>")


def test_nobody_else_names_sections_and_words_of_elf_vla() -> None:
    sections = frozenset(ELF_VLA.format.sections())
    found = {
        str(path.relative_to(ROOT)): text
        for _, path in modules()
        if (room := str(path.relative_to(ROOT))).startswith(("model/", "service/"))
        # Families that look like it have sections of the same names.
        and not room.startswith(("model/families/elf_vla/", "model/families/vla_world/"))
        for text in literals(path.read_text())
        if text in sections or any(word in text for word in ELF_VLA_WORDS)
    }
    # What a branch of CF-VLA's is counted as; a field of the HTTP contract of feedback.
    assert found == {
        "service/operations/service_metrics.py": "think",
        "service/routes/request_examples.py": "think",
    }


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


def test_literals_are_read_and_docstrings_are_not() -> None:
    source = '"""Thinking: it over."""\nsection = "revised_plan"\nplan = f"Thinking: {it}"\n'
    assert [named(text) for text in literals(source)] == [{"revised_plan"}, {"Thinking:"}]
    script = 'const thinking = draw.branch === "Thinking:" ? byId("plan") : `Thinking: ${it}`;'
    assert {*filter(None, script_literals(script))} == {"Thinking:", "plan", "Thinking: ${it}"}
