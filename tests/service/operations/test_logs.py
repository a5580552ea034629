from __future__ import annotations

import json
import os
import sys

import pytest
import structlog

from looktwice.service.operations.logs import configure_logging, lines_lost


def fail() -> None:
    pictures = "x" * 100_000
    raise ValueError(f"about {len(pictures)}")


@pytest.mark.parametrize("log_format", ["json", "console"])
def test_errors_are_logged_without_the_callers_data(
    log_format: str, capsys: pytest.CaptureFixture[str]
) -> None:
    configure_logging("json" if log_format == "json" else "console")
    try:
        fail()
    except ValueError:
        structlog.stdlib.get_logger().exception("failed", scene="a")
    written = capsys.readouterr().err
    assert "about 100000" in written
    assert "xxxx" not in written
    if log_format == "json":
        line = json.loads(written)
        assert (line["event"], line["level"], line["scene"]) == ("failed", "error", "a")


def test_a_pipe_that_nobody_empties_holds_up_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb") as out, os.fdopen(writing, "w") as stuck:
        monkeypatch.setattr(sys, "stderr", stuck)
        configure_logging("json")
        log, before = structlog.stdlib.get_logger(), lines_lost()
        for number in range(2000):
            log.info("spoken", number=number, text="x" * 100)
        lost = lines_lost() - before
        assert 0 < lost < 2000
        # What was written is whole lines but for the last, and the next one begins on a line of its own.
        taken = out.read1(1 << 20)
        log.info("heard again", text="y" * 10)
        stuck.close()
        lines = (taken + out.read()).decode().splitlines()
    assert json.loads(lines[-1])["event"] == "heard again"
    assert [json.loads(line)["number"] for line in lines[: 2000 - lost]] == list(range(2000 - lost))


def test_a_line_longer_than_a_pipe_takes_at_once_is_written_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb") as out, os.fdopen(writing, "w") as read_later:
        monkeypatch.setattr(sys, "stderr", read_later)
        configure_logging("json")
        structlog.stdlib.get_logger().info("long", text="z" * 30_000)
        read_later.close()
        assert json.loads(out.read())["text"] == "z" * 30_000
