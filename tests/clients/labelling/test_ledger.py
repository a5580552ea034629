from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from looktwice.clients.labelling.dead_letters import FILE as LETTERS
from looktwice.clients.labelling.dead_letters import write_dead_letters
from looktwice.clients.labelling.ledger import FILE, Ledger, LedgerError
from looktwice.clients.labelling.teachers.teacher import Answer

CONFIG = {"model": "nano", "seed": 0}


def test_what_is_entered_is_there_in_the_next_process(tmp_path: Path) -> None:
    with Ledger(tmp_path) as ledger:
        run = ledger.run("rollout", CONFIG)
        ledger.finish(run, "a", "scene a", {"x": [1.5]})
        ledger.dead_letter(run, "b", "scene b", "no", status=422)
    with Ledger(tmp_path) as ledger:
        assert ledger.run("rollout", CONFIG) == run == ledger.the_run("rollout")
        assert ledger.run("rollout", {**CONFIG, "seed": 1}).id != run.id
        assert [ledger.has(key) for key in "abc"] == [True, True, False]
        (done,), (dead,) = ledger.entries(run), ledger.entries(run, "dead")
        assert (done.scene_id, done.record) == ("scene a", {"x": [1.5]})
        assert dead.record == {"reason": "no", "status": 422}
        assert (ledger.count(run), ledger.count(run, "dead")) == (1, 1)


def test_nothing_is_done_twice(tmp_path: Path) -> None:
    with Ledger(tmp_path) as ledger:
        run = ledger.run("rollout", CONFIG)
        ledger.finish(run, "a", "scene", {})
        with pytest.raises(LedgerError, match="twice"):
            ledger.finish(run, "a", "scene", {})


def test_one_process_at_a_time(tmp_path: Path) -> None:
    with Ledger(tmp_path), pytest.raises(LedgerError, match="at work"):
        Ledger(tmp_path)
    Ledger(tmp_path).close()


def test_other_files_are_no_ledgers(tmp_path: Path) -> None:
    (tmp_path / FILE).write_bytes(b"something else" * 100)
    with pytest.raises(LedgerError, match="cannot be used"):
        Ledger(tmp_path)
    newer = tmp_path / "newer"
    Ledger(newer).close()
    with sqlite3.connect(newer / FILE) as db:
        db.execute("PRAGMA user_version = 99")
    db.close()
    with pytest.raises(LedgerError, match="version 99"):
        Ledger(newer)
    with pytest.raises(LedgerError, match="version 99"):
        Ledger(newer)  # the lock was given back


def test_several_runs_want_to_be_told_apart(tmp_path: Path) -> None:
    with Ledger(tmp_path) as ledger:
        with pytest.raises(LedgerError, match="no rollout yet"):
            ledger.the_run("rollout")
        runs = [ledger.run("rollout", {**CONFIG, "seed": seed}) for seed in (0, 1)]
        for run in runs:
            ledger.finish(run, f"of {run.id}", "scene", {})
        with pytest.raises(LedgerError, match=runs[1].id[:8]):
            ledger.the_run("rollout")
        assert ledger.the_run("rollout", runs[1].id[:8]) == runs[1]
        assert {run.id for run in ledger.runs("rollout")} == {run.id for run in runs}


def test_answers_are_counted_with_those_that_were_no_use(tmp_path: Path) -> None:
    with Ledger(tmp_path) as ledger:
        run = ledger.run("label", CONFIG)
        ledger.answered(run, "a", 1, Answer("no", 100, 10, 0.5))
        ledger.answered(run, "a", 2, Answer("yes", 110, 20, 0.25))
        assert ledger.answers("a") == [Answer("no", 100, 10, 0.5), Answer("yes", 110, 20, 0.25)]
        assert tuple(ledger.spent(run)) == (2, 210, 30, 0.75)
        assert tuple(ledger.spent(ledger.run("label", {}))) == (0, 0, 0, 0.0)


def test_what_is_kept_can_be_chosen_anew(tmp_path: Path) -> None:
    with Ledger(tmp_path) as ledger:
        run, other = ledger.run("rollout", CONFIG), ledger.run("rollout", {})
        for key in "abc":
            ledger.finish(run, key, f"scene {key}", {"key": key})
        ledger.finish(other, "d", "scene d", {})
        ledger.select(run, [("a", [0]), ("b", [0])])
        ledger.select(other, [("d", [0])])
        ledger.select(run, [("b", [0, 2, 3]), ("c", [1])])
        kept = {key: ledger.selected(key) for key in "abcd"}
        assert {key: found and found[1] for key, found in kept.items()} == {
            "a": None,
            "b": [0, 2, 3],
            "c": [1],
            "d": [0],
        }
        assert (
            ledger.selected_draws(run, 1),
            ledger.selected_draws(run, 9),
            ledger.selected_draws(other, 9),
        ) == (
            2,
            4,
            1,
        )
        with pytest.raises(sqlite3.IntegrityError):
            ledger.select(run, [("a", [0]), ("a", [0])])
        assert ledger.selected_draws(run, 1) == 2, "a choice that fails changes nothing"


def test_dead_letters_are_written_and_can_be_tried_again(tmp_path: Path) -> None:
    with Ledger(tmp_path) as ledger:
        run = ledger.run("label", CONFIG)
        ledger.finish(run, "a", "scene a", {})
        ledger.answered(run, "b", 1, Answer("no"))
        ledger.dead_letter(run, "b", "scene b", "leaks", text="no")
        assert write_dead_letters(ledger, tmp_path) == 1
        (line,) = (tmp_path / LETTERS).read_text().splitlines()
        assert '"scene_id": "scene b"' in line
        assert '"reason": "leaks"' in line
        assert ledger.forget_dead(run) == 1
        assert not ledger.has("b")
        assert ledger.answers("b") == [], "a new question gets new answers"
        assert ledger.has("a")
        assert write_dead_letters(ledger, tmp_path) == 0
        assert (tmp_path / LETTERS).read_text() == ""


def test_what_a_helper_entered_is_taken_over_once(tmp_path: Path) -> None:
    with Ledger(None) as helper, Ledger(tmp_path) as ledger:
        run = ledger.run("label", {})
        helper.run("label", {})
        helper.finish(run, "a", "scene a", {"x": 1})
        helper.answered(run, "a", 1, Answer("yes", 10, 5))
        helper.dead_letter(run, "b", "scene b", "no")
        for _ in range(2):
            ledger.take_over(run, helper.entered(run))
        assert (ledger.count(run), ledger.count(run, "dead")) == (1, 1)
        assert ledger.answers("a") == [Answer("yes", 10, 5)]
        assert set(ledger.keys_of(run, ["scene a", "scene b", "scene c"])) == {"a", "b"}


def test_a_helper_goes_on_with_answers_that_were_paid_for(tmp_path: Path) -> None:
    with Ledger(None) as helper, Ledger(tmp_path) as ledger:
        run = ledger.run("label", {})
        for key in ("ended", "broken off"):
            ledger.answered(run, key, 1, Answer(f"{key}?", 10, 5))
        ledger.finish(run, "ended", "scene", {})
        helper.run("label", {})
        helper.take_over(run, ledger.begun(run))
        assert helper.answers("ended") == []
        assert helper.answers("broken off") == [Answer("broken off?", 10, 5)]
        helper.answered(run, "broken off", 2, Answer("yes", 20, 5))
        ledger.take_over(run, helper.entered(run))
        assert [answer.text for answer in ledger.answers("broken off")] == ["broken off?", "yes"]
        assert ledger.spent(run).input_tokens == 40
