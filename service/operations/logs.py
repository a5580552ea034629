"""How the service logs: one line an event, JSON for machines or readable for people."""

from __future__ import annotations

import contextlib
import logging
import os
import select
import sys
from dataclasses import dataclass
from typing import Final, Literal, TextIO

import structlog

_LIBRARIES: Final = ("uvicorn", "uvicorn.error", "asyncio", "opentelemetry")


def configure_logging(log_format: Literal["json", "console"]) -> None:
    """Send structlog's events to standard error; values bound to the request come with every line."""
    rendering: list[structlog.typing.Processor] = (
        [structlog.processors.format_exc_info, structlog.processors.JSONRenderer()]
        if log_format == "json"
        # The default traceback shows local variables: megabytes of pictures.
        else [structlog.dev.ConsoleRenderer(exception_formatter=structlog.dev.plain_traceback)]
    )
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            *rendering,
        ],
        logger_factory=lambda *_: _StandardError(),
        cache_logger_on_first_use=False,
    )
    for name in _LIBRARIES:
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [_Handler(logging.WARNING)], False


class _StandardError:
    """Writes lines; one that cannot be written at once is lost, since planning must go on meanwhile.

    A pipe whose reader has stopped, or a full disk, would hold up the whole service otherwise.
    """

    def msg(self, text: str) -> None:
        line = f"{text}\n".encode(errors="backslashreplace")
        begun = b"\n" if _lost.within_line else b""
        # Looked up for each line, so that a redirected standard error is honoured.
        left = write_now(sys.stderr, begun + line)
        _lost.count += left > 0
        _lost.within_line = 0 < left < len(line)

    debug = info = warning = error = critical = exception = msg


@dataclass
class _Lost:
    count: int = 0
    within_line: bool = False


_lost = _Lost()


def lines_lost() -> int:
    """Lines of this process that were never written, or only in part."""
    return _lost.count


def write_now(stream: TextIO, text: bytes) -> int:
    """Write UTF-8 ``text`` as far as that takes no waiting; how many bytes are left."""
    rest = memoryview(text)
    with contextlib.suppress(OSError, ValueError):
        try:
            place = stream.fileno()
        except (OSError, ValueError, AttributeError):  # no file of the system's
            stream.write(text.decode())
            return 0
        writable = select.poll()
        writable.register(place, select.POLLOUT)
        while rest and any(event & select.POLLOUT for _, event in writable.poll(0)):
            # A pipe that can be written to takes so many bytes without waiting (POSIX, `write`).
            rest = rest[os.write(place, rest[: select.PIPE_BUF]) :]
    return len(rest)


class _Handler(logging.Handler):
    """What libraries log, as events of ours."""

    def emit(self, record: logging.LogRecord) -> None:
        structlog.get_logger().log(
            record.levelno, record.getMessage(), logger=record.name, exc_info=record.exc_info
        )
