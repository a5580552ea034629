"""How the service logs: one line an event, JSON for machines or readable for people."""

from __future__ import annotations

import contextlib
import logging
import sys
from typing import Final, Literal

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
    """Writes lines; one that cannot be written is lost, since planning must go on when a disk is full."""

    def msg(self, line: str) -> None:
        # Looked up for each line, so that a redirected standard error is honoured.
        with contextlib.suppress(OSError, ValueError):
            print(line, file=sys.stderr, flush=True)

    debug = info = warning = error = critical = exception = msg


class _Handler(logging.Handler):
    """What libraries log, as events of ours."""

    def emit(self, record: logging.LogRecord) -> None:
        structlog.get_logger().log(
            record.levelno, record.getMessage(), logger=record.name, exc_info=record.exc_info
        )
