"""Names use the words of docs/glossary.md, not those that it avoids, and one name stands for one thing."""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from tests.test_architecture import ROOT, modules, within

OTHER_SENSES = frozenset(
    {
        # What the glossary says itself in another row, such as a teacher, a lane or a reason.
        *("action", "control", "draft", "failure", "lane", "reason", "rollout", "row", "teacher"),
        # The field's words, and those of programming languages.
        *("agents", "annotation", "cache", "command", "error", "fault", "frame", "generation"),
        *("grammar", "group", "job", "node", "page", "phase", "run", "runner", "sample", "sampling", "score"),
        *("sequence", "tick", "timeout", "tokenizer", "verdict", "version", "waypoints"),
        # Words of others: the OpenAI API's completion, NAVSIM's past motion, a tensor's layout.
        *("block", "completion", "layout", "past"),
        # Parts of other words: a labeller writes plans from trajectories, an engine warms up.
        *("labeller", "up"),
        # Positions, in a picture or on a road; paths of a batch or of lanes; parts of a checkpoint.
        *("ahead", "path", "place", "places", "parts"),
        # Verbs, and a load test whose figures count.
        *("keep", "valid"),
    }
)
"""Words that are to be avoided for one thing and are right for another."""


FOREIGN = frozenset(
    {
        *("chat_template", "get_dummy_mm_data", "get_dummy_text", "get_version", "pixel_values_videos"),
        *("timeout_keep_alive_handler", "user_message", "video_grid_thw"),
    }
)
"""Functions that others name: transformers, vLLM, uvicorn, alpasim, and chat completions' roles."""

SAME_CLASSES = frozenset(
    {
        *("Agent", "Attempt", "Clip", "CodesWritten", "Controls", "Draw", "Edges", "LabelledScene"),
        *("MetaAction", "ModelCard", "Motion", "Plan", "PlanChange", "PlanRequest", "Scene", "Section"),
        "Track",
    }
)
"""Classes of the HTTP contract (`clients/wire`) that are called as what they carry: users import them by
these names, and the API's description has them. There may be fewer, and none beside them."""
CONTRACT = ("clients/wire", "clients/wire_imagine")

SAME_FILES = {
    "a command, a path or a body of the API, as what it is about": (
        *("blend", "failures", "feedback", "keys", "label", "ladder", "models", "perception", "plan"),
        *("scene", "scenes", "score", "events"),
    ),
    "one of each engine, of each family, of the network": (
        "engine",
        "format",
        "inputs",
        "read",
        "targets",
    ),
    "a network, and what teaches it": ("composer", "visual_codes"),
    "users name both: `looktwice.service.app`, and Serve's `import_path`": ("app",),
}
"""Names of several files, by the reason. There may be fewer, and none beside them."""


def avoided() -> set[str]:
    """Single words of the glossary's last column."""
    rows = [line.strip("|").split("|") for line in (ROOT / "docs/glossary.md").read_text().splitlines()]
    columns = [re.sub(r"\([^)]*\)", "", row[2]) for row in rows if len(row) == 3]
    words = {word.strip().lower() for column in columns for word in column.split(",")}
    return {word for word in words if word.isalpha()} - {"avoid"}


def names() -> Iterator[tuple[str, str]]:
    """Every module, class and public function with the module that it stands in."""
    for module, path in modules():
        yield module, module.rpartition(".")[2]
        yield from ((module, each) for each in classes(path))
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not node.name.startswith("_"):
                yield module, node.name


def classes(path: Path) -> Iterator[str]:
    """Names of the classes in a file."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ClassDef):
            yield node.name


def written() -> Iterator[tuple[str, Path]]:
    """All modules but the code in the folders of bundled checkpoints, each of which is whole by itself."""
    return ((module, path) for module, path in modules() if not within(module, ("model/bundled",)))


def repeated(found: Iterable[str]) -> set[str]:
    """What is found twice or more."""
    return {each for each, times in Counter(found).items() if times > 1}


def words_of(name: str) -> set[str]:
    """The words that a name is made of, in the plural and the singular: `KvRows` is of kv, rows and row."""
    words = {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)}
    return words | {word.removesuffix("s") for word in words}


def test_names_use_no_word_that_the_glossary_avoids() -> None:
    wrong = avoided() - OTHER_SENSES
    found = {(module, name): words_of(name) & wrong for module, name in names() if name not in FOREIGN}
    assert {each: words for each, words in found.items() if words} == {}


def test_words_with_another_sense_are_avoided_and_used() -> None:
    used = {word for _, name in names() for word in words_of(name)}
    assert OTHER_SENSES - avoided() == set()
    assert OTHER_SENSES - used == set()
    assert FOREIGN - {name for _, name in names()} == set()


def test_classes_of_one_name_are_one_thing_and_its_body_in_the_api() -> None:
    everywhere = [(module, name) for module, path in written() for name in classes(path)]
    assert repeated(name for _, name in everywhere) == SAME_CLASSES
    inside = [name for module, name in everywhere if not within(module, CONTRACT)]
    assert repeated(inside) == set()


def test_files_of_one_name_have_a_reason() -> None:
    names = [path.stem for _, path in written() if path.stem not in ("__init__", "__main__")]
    reasons = [name for several in SAME_FILES.values() for name in several]
    assert repeated(reasons) == set()
    assert repeated(names) == {*reasons}
