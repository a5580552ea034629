"""Scores worked out in a process of its own, which can be ended.

A request within all bounds can name a map that takes minutes and gigabytes to look plans up in: outlines cost
as much as they have sides side by side. So scores are worked out where memory and time have an end that harms
nobody, and where they take nothing of what planning needs.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import resource
import struct
import sys
import time
import traceback
from pathlib import Path
from typing import BinaryIO, Final

from pydantic import BaseModel

import looktwice.clients.wire_feedback as wire_feedback
import looktwice.clients.wire_scores as wire_scores
from looktwice.clients.wire import Fault
from looktwice.service.problems import INVALID_LABELS, KINDS, ProblemError
from looktwice.service.scenes.bundled import BundledScenes
from looktwice.service.scoring.request_scores import scored
from looktwice.service.scoring.rule_feedback import FeedbackAnswer, answer_feedback

MAX_MEMORY_BYTES: Final = 768_000_000
"""Of data; about 150 MB are taken by libraries."""
MAX_CPU_S: Final = 20
"""Four thousand plans on a usual map take one second."""
_MAX_WAIT_S: Final = 3 * MAX_CPU_S
"""On a machine that is busy otherwise."""
_LENGTH: Final = struct.Struct(">I")
_DONE, _REFUSED, _FAILED = b"d", b"r", b"f"
_SCORE, _FEEDBACK = "score", "feedback"
_RUN: Final = (
    "import sys; from pathlib import Path; from looktwice.service.scoring.process import main; "
    "main(Path(sys.argv[1]))"
)


class Scorer:
    """One scoring process for the whole service, begun when it is first needed.

    Args:
        bundled: scene file or folder that requests may name scenes of.
    """

    def __init__(self, bundled: Path) -> None:
        self._bundled = bundled
        self._process: asyncio.subprocess.Process | None = None
        self._turn = asyncio.Lock()

    async def score(self, asked: wire_scores.ScoreRequest, request_id: str) -> wire_scores.ScoreResponse:
        """The answer to one request, in turn; who stops waiting ends the work.

        Raises:
            ProblemError: what `scored` refuses, and what takes too much to be scored.
        """
        told = await self._work(_SCORE, asked, request_id)
        return wire_scores.ScoreResponse.model_validate_json(told)

    async def feedback(self, asked: wire_feedback.FeedbackRequest, request_id: str) -> FeedbackAnswer:
        """Feedback by rule on one request's trajectories, and what another teacher would be asked.

        Raises:
            ProblemError: what `answer_feedback` refuses, and what takes too much to be scored.
        """
        return FeedbackAnswer.of_json(await self._work(_FEEDBACK, asked, request_id))

    async def _work(self, what: str, asked: BaseModel, request_id: str) -> bytes:
        content = json.dumps([what, request_id, asked.model_dump()]).encode()
        async with self._turn:
            try:
                async with asyncio.timeout(_MAX_WAIT_S):
                    kind, told = await self._ask(content)
            except (TimeoutError, asyncio.IncompleteReadError, ConnectionError):
                await self._end()
                raise _too_much() from None
            except BaseException:
                await self._end()
                raise
        if kind == _DONE:
            return told
        if kind == _REFUSED:
            slug, detail, faults = json.loads(told)
            raise ProblemError(
                next(each for each in KINDS if each.slug == slug),
                detail,
                [Fault(**fault) for fault in faults],
            )
        raise RuntimeError(told.decode(errors="replace"))

    async def close(self) -> None:
        """End the process; whoever waits for it is refused."""
        await self._end()

    async def _ask(self, content: bytes) -> tuple[bytes, bytes]:
        if self._process is None or self._process.returncode is not None:
            self._process = await asyncio.create_subprocess_exec(
                # Not from where the service was started: that may hold modules of the same names.
                *(sys.executable, "-P", "-c", _RUN, str(self._bundled)),
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.DEVNULL,
            )
        write, read = self._process.stdin, self._process.stdout
        assert write is not None
        assert read is not None
        write.write(_LENGTH.pack(len(content)) + content)
        await write.drain()
        kind = await read.readexactly(1)
        (length,) = _LENGTH.unpack(await read.readexactly(_LENGTH.size))
        return kind, await read.readexactly(length)

    async def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()


def main(bundled: Path) -> None:
    """Answer requests from standard input on standard output, until it ends."""
    resource.setrlimit(resource.RLIMIT_DATA, (MAX_MEMORY_BYTES, MAX_MEMORY_BYTES))
    scenes = BundledScenes(bundled)
    while len(length := sys.stdin.buffer.read(_LENGTH.size)) == _LENGTH.size:
        content = sys.stdin.buffer.read(_LENGTH.unpack(length)[0])
        # Beyond the soft limit the system ends the process.
        until_s = int(time.process_time()) + 1 + MAX_CPU_S
        resource.setrlimit(resource.RLIMIT_CPU, (until_s, resource.RLIM_INFINITY))
        _tell(sys.stdout.buffer, *_answer(content, scenes))


def _answer(content: bytes, scenes: BundledScenes) -> tuple[bytes, bytes]:
    what, request_id, document = json.loads(content)
    try:
        if what == _FEEDBACK:
            wanted = wire_feedback.FeedbackRequest.model_validate(document)
            return _DONE, answer_feedback(wanted, scenes, request_id).to_json()
        asked = wire_scores.ScoreRequest.model_validate(document)
        return _DONE, scored(asked, scenes, request_id).model_dump_json().encode()
    except ProblemError as problem:
        return _REFUSED, _refusal(problem)
    except MemoryError:
        return _REFUSED, _refusal(_too_much())
    except Exception:  # the service's log is where it belongs
        return _FAILED, traceback.format_exc().encode()


def _refusal(problem: ProblemError) -> bytes:
    faults = [fault.model_dump() for fault in problem.errors]
    return json.dumps([problem.kind.slug, problem.detail, faults]).encode()


def _too_much() -> ProblemError:
    detail = (
        f"this takes more than {MAX_CPU_S} s or {MAX_MEMORY_BYTES // 10**6} MB to score; "
        "send fewer trajectories, or less of the map"
    )
    return ProblemError(INVALID_LABELS, detail)


def _tell(out: BinaryIO, kind: bytes, content: bytes) -> None:
    out.write(kind + _LENGTH.pack(len(content)) + content)
    out.flush()
