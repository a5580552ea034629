"""The ledger of a build: what came of every piece of work, in SQLite, and what teachers were paid for.

Every line is a transaction of its own that is on the disk before the next piece of work ends. A run that was
killed at any moment finds all of them again, and neither does nor pays them twice.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Literal, NamedTuple, Self

from looktwice.clients.labelling.teachers.teacher import Answer
from looktwice.model.driving.hashing import hash_of

Stage = Literal["rollout", "outcomes", "label", "inference", "feedback"]
State = Literal["done", "dead"]
Record = Mapping[str, Any]

FILE: Final = "ledger.sqlite"
SCHEMA_VERSION: Final = 3
"""Of records; part of every key, so that a newer one does not take an older one's work for its own."""

_TABLES: Final = """
CREATE TABLE IF NOT EXISTS runs (run TEXT PRIMARY KEY, stage TEXT NOT NULL, config TEXT NOT NULL) STRICT;
CREATE TABLE IF NOT EXISTS outcomes (
    key TEXT PRIMARY KEY,
    run TEXT NOT NULL REFERENCES runs,
    scene_id TEXT NOT NULL,
    state TEXT NOT NULL CHECK (state IN ('done', 'dead')),
    record TEXT NOT NULL,
    ended_at TEXT NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ', 'now'))
) STRICT;
CREATE INDEX IF NOT EXISTS outcomes_of_run ON outcomes (run, state);
CREATE INDEX IF NOT EXISTS outcomes_of_scene ON outcomes (scene_id);
CREATE TABLE IF NOT EXISTS kept (key TEXT PRIMARY KEY REFERENCES outcomes, draws TEXT NOT NULL) STRICT;
CREATE TABLE IF NOT EXISTS answers (
    key TEXT NOT NULL,
    run TEXT NOT NULL REFERENCES runs,
    attempt INTEGER NOT NULL,
    answer TEXT NOT NULL,
    PRIMARY KEY (key, attempt)
) STRICT;
"""


class LedgerError(RuntimeError):
    """A ledger that cannot be used as asked; the text says what to do."""


@dataclass(frozen=True)
class StageRun:
    """A stage with everything that decides its outcomes besides the scenes.

    Attributes:
        id: stands for the rest.
        stage: which.
        config: model or teacher with revision, sampling, prompt version.
    """

    id: str
    stage: Stage
    config: Record


@dataclass(frozen=True)
class Entry:
    """What came of one piece of work."""

    key: str
    scene_id: str
    state: State
    record: Record
    ended_at: str


class Spent(NamedTuple):
    """What teachers' answers took."""

    answers: int
    input_tokens: int
    output_tokens: int
    cost_usd: float

    def since(self, before: Spent) -> dict[str, float]:
        """What was spent after ``before``, by name."""
        return {name: now - then for name, now, then in zip(self._fields, self, before, strict=True)}


class Entered(NamedTuple):
    """Rows of a run: outcomes (key, scene, state, record) and answers (key, attempt, answer)."""

    outcomes: list[tuple[str, str, str, str]]
    answers: list[tuple[str, int, str]]


class Ledger:
    """One folder's ledger, for one process at a time.

    Args:
        folder: None for a ledger in memory: what a helper enters until the folder's ledger takes it over.

    Raises:
        LedgerError: another process has it, or it is of another version.
    """

    def __init__(self, folder: Path | None) -> None:
        if folder is None:
            self._lock = None
            self._db = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
            self._open()
            return
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / f"{FILE}.lock").open("w")
        self._lock = lock
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            raise LedgerError(f"another build is at work in {folder}; wait until it has ended") from None
        # Every statement is a transaction of its own. Scenes are read, and looked up, on another thread;
        # the library takes one statement at a time.
        self._db = sqlite3.connect(folder / FILE, isolation_level=None, check_same_thread=False)
        try:
            self._open()
        except (sqlite3.DatabaseError, LedgerError) as error:
            self.close()
            raise LedgerError(f"{folder / FILE} cannot be used: {error}") from error

    def _open(self) -> None:
        self._db.execute("PRAGMA journal_mode = WAL")
        self._db.execute("PRAGMA synchronous = FULL")
        (version,) = self._db.execute("PRAGMA user_version").fetchone()
        if version not in (0, SCHEMA_VERSION):
            raise LedgerError(f"the ledger has version {version}, this LookTwice writes {SCHEMA_VERSION}")
        self._db.executescript(_TABLES)
        self._db.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")

    @staticmethod
    def copy(folder: Path, target: Path) -> None:
        """Copy a folder's ledger, as it is at this moment, into another folder."""
        with (
            contextlib.closing(sqlite3.connect(f"file:{folder / FILE}?mode=ro", uri=True)) as source,
            contextlib.closing(sqlite3.connect(target / FILE)) as copied,
        ):
            source.backup(copied)

    def close(self) -> None:
        """Let others have it."""
        self._db.close()
        if self._lock is not None:
            self._lock.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def run(self, stage: Stage, config: Record) -> StageRun:
        """The run of that configuration, begun where there is none yet."""
        run = StageRun(hash_of(SCHEMA_VERSION, stage, dict(config)), stage, config)
        self._db.execute(
            "INSERT OR IGNORE INTO runs VALUES (?, ?, ?)", (run.id, stage, json.dumps(dict(config)))
        )
        return run

    def runs(self, stage: Stage) -> list[StageRun]:
        """All runs of a stage that have outcomes, the latest first."""
        rows = self._db.execute(
            "SELECT run, config FROM runs JOIN outcomes USING (run) WHERE stage = ? "
            "GROUP BY run ORDER BY max(ended_at) DESC",
            (stage,),
        )
        return [StageRun(id, stage, json.loads(config)) for id, config in rows]

    def the_run(self, stage: Stage, beginning: str | None = None) -> StageRun:
        """The only run of a stage, or the one whose id begins so.

        Raises:
            LedgerError: there is none, or more than one.
        """
        runs = [run for run in self.runs(stage) if run.id.startswith(beginning or "")]
        if len(runs) == 1:
            return runs[0]
        if not runs:
            raise LedgerError(
                f"there is no {stage} yet" + (f" whose id begins with {beginning}" if beginning else "")
            )
        told = "; ".join(f"{run.id[:8]}: {json.dumps(dict(run.config))}" for run in runs)
        raise LedgerError(f"there are several runs of {stage}, say which: {told}")

    def has(self, key: str) -> bool:
        """Whether a piece of work has ended, well or not."""
        return self._db.execute("SELECT 1 FROM outcomes WHERE key = ?", (key,)).fetchone() is not None

    def find(self, key: str) -> Entry | None:
        """What is done under that key."""
        row = self._db.execute(
            "SELECT scene_id, record, ended_at FROM outcomes WHERE key = ? AND state = 'done'", (key,)
        ).fetchone()
        if row is None:
            return None
        scene_id, record, ended_at = row
        return Entry(key, scene_id, "done", json.loads(record), ended_at)

    def finish(self, run: StageRun, key: str, scene_id: str, record: Record) -> None:
        """A piece of work is done."""
        self._end(run, key, scene_id, "done", record)

    def dead_letter(self, run: StageRun, key: str, scene_id: str, reason: str, **more: Any) -> None:
        """A piece of work cannot be done."""
        self._end(run, key, scene_id, "dead", {"reason": reason, **more})

    def _end(self, run: StageRun, key: str, scene_id: str, state: State, record: Record) -> None:
        content = json.dumps(dict(record))
        try:
            self._db.execute(
                "INSERT INTO outcomes (key, run, scene_id, state, record) VALUES (?, ?, ?, ?, ?)",
                (key, run.id, scene_id, state, content),
            )
        except sqlite3.IntegrityError as error:
            raise LedgerError(f"scene {scene_id} was done twice") from error

    def entries(self, run: StageRun, state: State = "done") -> Iterator[Entry]:
        """What ended in a run, by scene."""
        rows = self._db.execute(
            "SELECT key, scene_id, record, ended_at FROM outcomes WHERE run = ? AND state = ? "
            "ORDER BY scene_id, key",
            (run.id, state),
        )
        for key, scene_id, record, ended_at in rows:
            yield Entry(key, scene_id, state, json.loads(record), ended_at)

    def latest(self, run: StageRun, count: int) -> list[Entry]:
        """What ended last in a run."""
        rows = self._db.execute(
            "SELECT key, scene_id, state, record, ended_at FROM outcomes WHERE run = ? "
            "ORDER BY rowid DESC LIMIT ?",
            (run.id, count),
        )
        return [
            Entry(key, scene_id, state, json.loads(record), at) for key, scene_id, state, record, at in rows
        ]

    def count(self, run: StageRun, state: State = "done") -> int:
        """How many ended so."""
        (count,) = self._db.execute(
            "SELECT count(*) FROM outcomes WHERE run = ? AND state = ?", (run.id, state)
        ).fetchone()
        return int(count)

    def forget_dead(self, run: StageRun) -> int:
        """Make what could not be done undone, with the answers to it; returns how many there were."""
        with self._all_or_nothing():
            dead = "SELECT key FROM outcomes WHERE run = ? AND state = 'dead'"
            self._db.execute(f"DELETE FROM answers WHERE key IN ({dead})", (run.id,))
            gone = self._db.execute("DELETE FROM outcomes WHERE run = ? AND state = 'dead'", (run.id,))
        return gone.rowcount

    def select(self, run: StageRun, draws: Iterable[tuple[str, Sequence[int]]]) -> None:
        """Choose what the next stage works on: keys, each with some of its draws.

        What was chosen of the run before is chosen no more.
        """
        with self._all_or_nothing():
            self._db.execute(
                "DELETE FROM kept WHERE key IN (SELECT key FROM outcomes WHERE run = ?)", (run.id,)
            )
            self._db.executemany(
                "INSERT INTO kept VALUES (?, ?)", ((key, json.dumps(list(some))) for key, some in draws)
            )

    def selected(self, key: str) -> tuple[Entry, list[int]] | None:
        """What is done under that key, with the draws that were chosen of it, if any were."""
        row = self._db.execute(
            "SELECT scene_id, record, ended_at, draws FROM outcomes JOIN kept USING (key) WHERE key = ?",
            (key,),
        ).fetchone()
        if row is None:
            return None
        scene_id, record, ended_at, draws = row
        return Entry(key, scene_id, "done", json.loads(record), ended_at), json.loads(draws)

    def selected_draws(self, run: StageRun, most: int) -> int:
        """How many draws of a run are chosen, at most so many of each piece of work."""
        (count,) = self._db.execute(
            "SELECT coalesce(sum(min(json_array_length(draws), ?)), 0) "
            "FROM outcomes JOIN kept USING (key) WHERE run = ?",
            (most, run.id),
        ).fetchone()
        return int(count)

    @contextlib.contextmanager
    def _all_or_nothing(self) -> Iterator[None]:
        self._db.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            self._db.execute("ROLLBACK")
            raise
        self._db.execute("COMMIT")

    def answered(self, run: StageRun, key: str, attempt: int, answer: Answer) -> None:
        """A teacher has answered: kept before anything is made of it."""
        content = json.dumps(answer._asdict())
        self._db.execute("INSERT INTO answers VALUES (?, ?, ?, ?)", (key, run.id, attempt, content))

    def answers(self, key: str) -> list[Answer]:
        """What a teacher has answered so far, in order."""
        rows = self._db.execute("SELECT answer FROM answers WHERE key = ? ORDER BY attempt", (key,))
        return [Answer(**json.loads(answer)) for (answer,) in rows]

    def begun(self, run: StageRun) -> Entered:
        """Answers to questions of a run that have no outcome yet, for a helper that goes on with them."""
        rows = self._db.execute(
            "SELECT key, attempt, answer FROM answers WHERE run = ? "
            "AND key NOT IN (SELECT key FROM outcomes WHERE run = ?)",
            (run.id, run.id),
        )
        return Entered([], rows.fetchall())

    def entered(self, run: StageRun) -> Entered:
        """All that was entered for a run, for another ledger to take over."""
        return Entered(
            self._db.execute(
                "SELECT key, scene_id, state, record FROM outcomes WHERE run = ?", (run.id,)
            ).fetchall(),
            self._db.execute("SELECT key, attempt, answer FROM answers WHERE run = ?", (run.id,)).fetchall(),
        )

    def take_over(self, run: StageRun, entered: Entered) -> None:
        """Enter what a helper has; what is there already stays as it is."""
        with self._all_or_nothing():
            self._db.executemany(
                "INSERT OR IGNORE INTO answers (key, run, attempt, answer) VALUES (?, ?, ?, ?)",
                ((key, run.id, attempt, answer) for key, attempt, answer in entered.answers),
            )
            self._db.executemany(
                "INSERT OR IGNORE INTO outcomes (key, run, scene_id, state, record) VALUES (?, ?, ?, ?, ?)",
                ((key, run.id, *rest) for key, *rest in entered.outcomes),
            )

    def keys_of(self, run: StageRun, scene_ids: Sequence[str]) -> list[str]:
        """What ended in a run for some scenes."""
        marks = ",".join("?" * len(scene_ids))
        rows = self._db.execute(
            f"SELECT key FROM outcomes WHERE run = ? AND scene_id IN ({marks})", (run.id, *scene_ids)
        )
        return [key for (key,) in rows]

    def spent(self, run: StageRun) -> Spent:
        """What a run's answers took, those that were no use included."""
        row = self._db.execute(
            "SELECT count(*), coalesce(sum(answer ->> 'input_tokens'), 0), "
            "coalesce(sum(answer ->> 'output_tokens'), 0), coalesce(sum(answer ->> 'cost_usd'), 0.0) "
            "FROM answers WHERE run = ?",
            (run.id,),
        ).fetchone()
        return Spent(*row)
