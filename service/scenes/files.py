"""Scene files that callers send, read in a process of its own.

Parquet packs so well that a small file can hold gigabytes, and what it holds is known only once it is
unpacked. So it is unpacked where memory and time have an end that harms nobody: in a process with limits.
"""

from __future__ import annotations

import asyncio
import contextlib
import resource
import sys
import tempfile
from itertools import islice
from pathlib import Path
from typing import Final

import pyarrow.parquet as pq

import looktwice.clients.wire as wire
from looktwice.model.driving.scene_store import SceneFileError, count_scenes, read_scenes
from looktwice.service.problems import INVALID_SCENE_FILE, ProblemError
from looktwice.service.scenes.bundled import MAX_SCENES_SHOWN, file_error_text, view

MAX_SCENES_IN_FILE: Final = 1000
MAX_UNPACKED_BYTES: Final = 256_000_000
"""Of a dropped file: Parquet packs so well that a small file could fill the memory."""
MAX_MEMORY_BYTES: Final = 512_000_000
"""Of data; about 150 MB are taken by libraries, and 130 MB more by 60 scenes."""
MAX_CPU_S: Final = 20
MAX_WAIT_S: Final = 3 * MAX_CPU_S
"""On a machine that is busy otherwise, where who reads goes last."""
MAX_ANSWER_BYTES: Final = 64_000_000
_PARQUET: Final = b"PAR1"
"""How a whole file begins, and how it ends."""
REFUSED: Final = 3
"""Exit status of a file that is told what is wrong with it."""


# Planning goes first: on a busy core, what a file takes is a tenth.
_READ: Final = (
    "import os, sys; os.nice(10); from pathlib import Path; from looktwice.service.scenes.files import main; "
    "sys.exit(main(Path(sys.argv[1])))"
)


async def read_scene_file(content: bytes) -> bytes:
    """The `wire.SceneFile` of a scene file's bytes, as JSON; raises `ProblemError` where it is none.

    Who stops waiting ends the process.
    """
    if not (content.startswith(_PARQUET) and content.endswith(_PARQUET)):
        raise _refusal("the file is not a whole Parquet file (truncated?)")
    with tempfile.TemporaryDirectory(prefix="looktwice-") as folder:
        path = Path(folder) / "scenes.parquet"
        path.write_bytes(content)
        reader = await asyncio.create_subprocess_exec(
            *(sys.executable, "-c", _READ, str(path)),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            limit=MAX_ANSWER_BYTES,
        )
        try:
            async with asyncio.timeout(MAX_WAIT_S):
                answer, complaint = await reader.communicate()
        except TimeoutError:
            raise _refusal(f"the file takes longer than {MAX_WAIT_S} s to read") from None
        finally:
            with contextlib.suppress(ProcessLookupError):
                reader.kill()
            await reader.wait()
    if reader.returncode == 0:
        return answer
    if reader.returncode == REFUSED:
        raise _refusal(complaint.decode(errors="replace"))
    raise _refusal("the file takes too much memory or time to read")


def _refusal(detail: str) -> ProblemError:
    return ProblemError(INVALID_SCENE_FILE, detail)


def scenes_of_file(path: Path) -> list[wire.LabelledScene]:
    """The first scenes of a Parquet file from outside; raises `ProblemError` where it is none of ours."""
    try:
        _refuse_bombs(path)
        return [view(scene) for scene in islice(read_scenes(path, dense=False), MAX_SCENES_SHOWN)]
    except SceneFileError as error:
        raise ProblemError(INVALID_SCENE_FILE, file_error_text(error, path, "the file")) from error


def _refuse_bombs(path: Path) -> None:
    if count_scenes(path) > MAX_SCENES_IN_FILE:
        raise SceneFileError(f"{path} holds more than {MAX_SCENES_IN_FILE} scenes")
    footer = pq.read_metadata(path)
    unpacked = sum(footer.row_group(group).total_byte_size for group in range(footer.num_row_groups))
    if unpacked > MAX_UNPACKED_BYTES:
        raise SceneFileError(
            f"{path} would unpack to {unpacked} bytes; at most {MAX_UNPACKED_BYTES} are read"
        )


def main(path: Path) -> int:
    """Write a file's scenes to standard output; what is wrong with it goes to standard error."""
    for kind, limit in ((resource.RLIMIT_DATA, MAX_MEMORY_BYTES), (resource.RLIMIT_CPU, MAX_CPU_S)):
        resource.setrlimit(kind, (limit, limit))
    try:
        answer = wire.SceneFile(scenes=scenes_of_file(path)).model_dump_json().encode()
    except ProblemError as error:
        sys.stderr.write(error.detail)
        return REFUSED
    if len(answer) > MAX_ANSWER_BYTES:
        sys.stderr.write(f"the file's scenes are {len(answer)} bytes to tell; at most {MAX_ANSWER_BYTES} are")
        return REFUSED
    sys.stdout.buffer.write(answer)
    return 0
