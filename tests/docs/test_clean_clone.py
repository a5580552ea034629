"""Both pages run as they stand, without a network; `make test-readme` runs the rest, as a maintainer does."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from looktwice.clients.importers.comma2k19 import FilmReader
from looktwice.clients.importers.recording import RecordingError
from looktwice.service.cli.commands import app
from tests.comma2k19 import SEGMENT
from tests.docs.clean_clone import (
    ACTIVATE,
    COMMANDS,
    HELP_ONLY,
    MINUTE,
    SERVE,
    TRIED,
    Faulty,
    Newcomer,
    blocks,
    follow_without_network,
    left_out,
    lines,
    listed,
)
from tests.sockets import free_port

ROOT = Path(__file__).parents[2]
PAGES = ("README.md", "docs/own-cameras.md")
LISTED = [each for page in ("README.md", COMMANDS) for each in listed((ROOT / page).read_text())]


def test_every_command_and_snippet_does_what_the_pages_say(tmp_path: Path) -> None:
    follow_without_network(tmp_path, free_port())


def test_what_is_left_out_stands_in_the_pages() -> None:
    commands = [
        line for page in PAGES for _, block in blocks((ROOT / page).read_text()) for line in lines(block)
    ]
    assert left_out().keys() <= set(commands)


@pytest.mark.parametrize(("command", "options"), LISTED)
def test_a_listed_command_has_the_options_that_are_shown(command: str, options: list[str]) -> None:
    told = CliRunner(env={"COLUMNS": "200"}).invoke(app, [*command.split(), "--help"])
    assert told.exit_code == 0, told.output
    assert [option for option in options if option not in told.output] == []


def commands_of(command: Any, *path: str) -> Iterator[str]:
    """The names of a command's own commands, down to those that have none."""
    if not hasattr(command, "commands"):
        yield " ".join(path)
        return
    for name, inner in command.commands.items():
        yield from commands_of(inner, *path, name)


def test_every_command_is_listed() -> None:
    assert set(commands_of(typer.main.get_command(app))) <= {name for name, _ in LISTED}


def test_every_command_that_is_listed_is_run_or_it_is_said_why_not() -> None:
    names = {name for name, _ in LISTED}
    assert not TRIED.keys() & HELP_ONLY.keys()
    assert names == TRIED.keys() | HELP_ONLY.keys()
    for name, command in TRIED.items():
        assert f"looktwice {name} " in f"{command} "


def test_the_real_minute_is_followed_wherever_its_film_can_be_read() -> None:
    try:
        readable = FilmReader(SEGMENT / "video.hevc", np.zeros(1)).picture(0).ndim == 3
    except RecordingError:
        readable = False
    assert (left_out().keys() & set(MINUTE) == set()) is readable


def test_a_command_that_takes_too_long_is_told_and_ended(tmp_path: Path) -> None:
    newcomer = Newcomer(tmp_path)
    newcomer.longest_s = 0.5
    with pytest.raises(Faulty, match=r"^sleep 600 \| cat\nis not done within"):
        newcomer.run("sleep 600 | cat")


def test_lines_are_joined_and_comments_left_out() -> None:
    assert lines("make plan    # installs\n\nlooktwice plan \\\n    --n 3\n") == [
        "make plan",
        "looktwice plan --n 3",
    ]


def test_alternatives_are_told_one_by_one_with_their_options() -> None:
    page = "`looktwice scenes show\\|pick` and `looktwice evaluate --scenes data`, `looktwice plan [SCENE…]`"
    assert listed(page) == [
        ("scenes show", []),
        ("scenes pick", []),
        ("evaluate", ["--scenes"]),
        ("plan", []),
    ]


@pytest.mark.parametrize("name", PAGES)
def test_no_command_hides_in_a_block_that_is_not_run(name: str) -> None:
    unread = [
        block for language, block in blocks((ROOT / name).read_text()) if language not in ("bash", "python")
    ]
    assert not [block for block in unread if re.search(r"^(looktwice|make|pip|python|curl) ", block, re.M)]


def test_the_readme_activates_before_it_serves() -> None:
    commands = [line for _, block in blocks((ROOT / "README.md").read_text()) for line in lines(block)]
    assert commands.index("make plan") < commands.index(ACTIVATE) < commands.index(SERVE)
    assert next(place for place, line in enumerate(commands) if line.startswith("curl ")) > commands.index(
        SERVE
    )
