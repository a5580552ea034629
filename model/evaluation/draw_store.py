"""Draws kept in a file, so that a long evaluation that was killed goes on where it was."""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import AsyncGenerator, Iterable, Sequence
from contextlib import aclosing
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import msgpack
import numpy as np
import numpy.typing as npt

from looktwice.model.driving.hashing import hash_of, scene_hash
from looktwice.model.driving.perceived import Perceived, PerceivedAgent
from looktwice.model.driving.plan import Plan, parse_plan
from looktwice.model.engines.engine import Draw, DrawFinished, Engine, EngineLoad, Event, PlanRequest, Started
from looktwice.model.families.family import Foreseen, NextPicture
from looktwice.model.network.model_card import ModelCard

_SCHEMA_VERSION: Final = 4
"""Part of every key, so that a draw that is kept otherwise is none that is known."""
_TUPLES: Final = ("codes", "times_s", "ids", "logprobs", "action")


class DrawStore:
    """An `Engine` in front of another, which is asked only what it has not answered before.

    The draws of a request are kept when the last of them has come; told by the model's revision, the scene
    with all that is in it, format, controls and the attempt that is refined, not by the request's name. What
    is answered from the file has no events but `Started` and its draws.

    Args:
        engine: that is asked.
        file: SQLite, made where it is not there; several engines may share it.

    Raises:
        ValueError: when it starts, ``file`` is something else.
    """

    def __init__(self, engine: Engine, file: Path) -> None:
        self._engine, self._file = engine, file
        self._kept: sqlite3.Connection | None = None

    @property
    def card(self) -> ModelCard:
        """The engine's."""
        return self._engine.card

    @property
    def load(self) -> EngineLoad:
        """The engine's."""
        return self._engine.load

    async def start(self) -> None:
        """Start the engine and open the file."""
        self._file.parent.mkdir(parents=True, exist_ok=True)
        kept = sqlite3.connect(self._file, isolation_level=None)
        try:
            kept.execute("PRAGMA journal_mode = WAL")
            kept.execute("CREATE TABLE IF NOT EXISTS draws (request TEXT PRIMARY KEY, draws BLOB) STRICT")
        except sqlite3.DatabaseError as error:
            kept.close()
            raise ValueError(f"{self._file} keeps no draws ({error}): name another file") from error
        self._kept = kept
        await self._engine.start()

    async def wait(self) -> None:
        """The engine's."""
        await self._engine.wait()

    async def stop(self) -> None:
        """Stop the engine and close the file."""
        await self._engine.stop()
        if self._kept is not None:
            self._kept.close()
            self._kept = None

    async def load_weights(self, checkpoint: Path) -> None:
        """The engine's; the draws of the old weights stay, and are found when these are back."""
        await self._engine.load_weights(checkpoint)

    def cancel(self, request_id: str) -> None:
        """The engine's."""
        self._engine.cancel(request_id)

    def prompt_tokens(self, request: PlanRequest) -> int:
        """The engine's."""
        return self._engine.prompt_tokens(request)

    def paint(self, request: PlanRequest, codes: Sequence[int]) -> npt.NDArray[np.uint8]:
        """The engine's."""
        return self._engine.paint(request, codes)

    async def submit(self, request: PlanRequest) -> AsyncGenerator[Event]:
        """See `Engine.submit`."""
        assert self._kept is not None, "an engine is started before it is asked"
        card = self.card
        found = self._kept.execute(
            "SELECT draws FROM draws WHERE request = ?", (_key(card, request),)
        ).fetchone()
        if found is not None:
            yield Started()
            for draw in _unpacked(found[0]):
                yield DrawFinished(draw)
            return
        draws = []
        async with aclosing(self._engine.submit(request)) as events:
            async for event in events:
                if isinstance(event, DrawFinished):
                    # It may have waited for new weights; while it is answered they stay.
                    card = self.card
                    draws.append(event.draw)
                yield event
        if len(draws) == request.controls.n:
            stored = _key(card, request), _packed(draws)
            self._kept.execute("INSERT OR REPLACE INTO draws VALUES (?, ?)", stored)


def _key(card: ModelCard, request: PlanRequest) -> str:
    prefill = request.controls.prefill
    controls = asdict(request.controls) | {"prefill": None if prefill is None else str(prefill)}
    scene, attempt = scene_hash(request.scene), request.attempt
    # No attempt, no part: what was kept before attempts counted is found again.
    tried = () if attempt is None else (attempt.trajectory.tobytes(), attempt.feedback)
    return hash_of(
        _SCHEMA_VERSION, card.name, card.revision, card.engine, request.format, controls, scene, *tried
    )


def _packed(draws: Iterable[Draw]) -> bytes:
    records = [
        vars(draw)
        | {
            "plan": _text(draw.plan),
            "revised_plan": _text(draw.revised_plan),
            "trajectory": draw.trajectory.astype("<f4").tobytes(),
            "tokens": dict(draw.tokens),
            "foreseen": None if draw.foreseen is None else asdict(draw.foreseen),
        }
        for draw in draws
    ]
    return zlib.compress(msgpack.packb(records))


def _unpacked(packed: bytes) -> list[Draw]:
    records: list[dict[str, Any]] = msgpack.unpackb(zlib.decompress(packed))
    return [
        Draw(
            **record
            | {
                "plan": _plan(record["plan"]),
                "revised_plan": _plan(record["revised_plan"]),
                "trajectory": np.frombuffer(record["trajectory"], "<f4").reshape(-1, 4),
                "foreseen": _foreseen(record["foreseen"]),
                **{name: tuple(record[name]) for name in _TUPLES},
            }
        )
        for record in records
    ]


def _foreseen(record: dict[str, Any] | None) -> Foreseen | None:
    if record is None:
        return None
    perceived, picture = record["perceived"], record["picture"]
    agents = tuple(PerceivedAgent(**agent) for agent in perceived["agents"])
    told = None if picture is None else NextPicture(picture["camera"], tuple(picture["codes"]))
    return Foreseen(**record | {"perceived": Perceived(**perceived | {"agents": agents}), "picture": told})


def _text(plan: Plan | None) -> str | None:
    return None if plan is None else str(plan)


def _plan(text: str | None) -> Plan | None:
    return None if text is None else parse_plan(text)
