"""Pages are written in short sentences: 18 words on average."""

from __future__ import annotations

import re
from pathlib import Path
from statistics import fmean

import pytest

ROOT = Path(__file__).parents[2]
LIMIT = 18
PAGES = [
    *sorted((ROOT / "docs").rglob("*.md")),
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
]


def sentences(page: str) -> list[str]:
    """Of a page's text: without code, tables, headings and addresses; a colon or semicolon ends none."""
    text = re.sub(r"^```.*?^```$", "", page, flags=re.S | re.M)
    text = re.sub(r"^ *(\||#|!\[).*$", "", text, flags=re.M)
    text = re.sub(r"\]\([^)]*\)", "]", re.sub(r"`[^`]*`", "X", text))
    paragraphs = re.split(r"\n\s*\n|\n(?= *(?:[*-]|\d+\.) )", text)
    found = (re.split(r"(?<=[.!?])\s+(?=[A-Z\[*(\d])", " ".join(each.split())) for each in paragraphs)
    return [sentence for paragraph in found for sentence in paragraph if sentence]


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.name))
def test_sentences_are_short(path: Path) -> None:
    assert fmean(len(sentence.split()) for sentence in sentences(path.read_text())) <= LIMIT


def test_sentences_are_told_apart() -> None:
    page = "# Title\n\nOne `a. B` here. Two [there](a.b).\n\n* three\n* four\n\n```\nNo.\n```\n| no | no |\n"
    assert sentences(page) == ["One X here.", "Two [there].", "* three", "* four"]
