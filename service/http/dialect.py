"""Problems as OpenAI's clients know them: an object ``error`` beside the problem document's own members."""

from __future__ import annotations

import re
from typing import Final

from looktwice.service.problems import ProblemError

_LIST: Final = "/v1/models"
_BELOW: Final = ("/v1/chat/", f"{_LIST}/")


def in_dialect(path: str) -> bool:
    """Whether OpenAI's dialect is spoken at ``path``."""
    return path == _LIST or path.startswith(_BELOW)


def dialect_status(status: int) -> int:
    """The status under which OpenAI's clients expect a problem: what breaks the contract is a 400 there."""
    return 400 if status == 422 else status


def dialect_error(problem: ProblemError) -> dict[str, str | None]:
    """What OpenAI's clients show: message, type, parameter at fault; the code is the problem's slug."""
    status = problem.kind.status
    if status == 429:
        type_ = "rate_limit_error"
    elif status == 401:
        type_ = "authentication_error"
    else:
        type_ = "server_error" if status >= 500 else "invalid_request_error"
    pointer = problem.errors[0].pointer if problem.errors else ""
    return {
        "message": problem.detail,
        "type": type_,
        "param": _parameter(pointer) or None,
        "code": problem.kind.slug,
    }


def _parameter(pointer: str) -> str:
    """A place as OpenAI names it: ``/messages/1/content`` is ``messages[1].content``."""
    return re.sub(r"/(\d+)(?=/|$)", r"[\1]", pointer).removeprefix("/").replace("/", ".")
