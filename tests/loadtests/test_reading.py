from __future__ import annotations

import json
from typing import Any

import pytest

from looktwice.loadtests.exchange import BAD_ANSWER, Verdict, read_answer
from looktwice.loadtests.mix import RequestKind


def read(kind: RequestKind, status: int, content: Any) -> Verdict:
    return read_answer(kind, status, json.dumps(content).encode())


def test_an_answer_that_thought_in_any_draw_is_one_that_thinks() -> None:
    direct, thought = {"thinking": None}, {"thinking": "A car."}
    assert read(RequestKind(n=2), 200, {"draws": [direct, direct]}).branch == "direct"
    assert read(RequestKind(n=2), 200, {"draws": [direct, thought]}).branch == "think"
    assert read(RequestKind("reflect", n=2), 200, {"draws": [direct, thought]}).branch == "reflect"


def test_deadlines_are_taken_over() -> None:
    told = read(RequestKind(n=1), 200, {"draws": [{}], "deadline": {"met": False, "cut": [0, 2, 5]}})
    assert (told.deadline_met, told.cut) == (False, 3)
    assert read(RequestKind(n=1), 200, {"draws": [{}], "deadline": None}).deadline_met is None


@pytest.mark.parametrize("content", [b"", b"<html>", b"{}", b'{"draws": [{}]}'])
def test_an_answer_without_its_draws_is_no_answer(content: bytes) -> None:
    assert read_answer(RequestKind(n=2), 200, content) == BAD_ANSWER


def test_load_is_refused_and_everything_else_fails() -> None:
    assert read(RequestKind(), 429, {"type": "https://x/queue-full"}) == Verdict("rejected", "queue-full")
    assert read(RequestKind(), 503, {"type": "https://x/not-ready"}) == Verdict("failed", "not-ready")
    assert read_answer(RequestKind(), 502, b"<html>") == Verdict("failed", "http-502")


def test_a_batch_is_as_good_as_its_worst_part() -> None:
    def batch(*statuses: int) -> Verdict:
        return read(RequestKind("batch"), 200, {"results": [{"status": status} for status in statuses]})

    assert batch(200, 200).branch == "batch"
    assert batch(200, 429, 200).outcome == "rejected"
    assert batch(200, 422) == Verdict("failed", "http-422")


def test_a_label_is_a_reflection() -> None:
    assert read(RequestKind("label", 1), 200, {"reflection": "Slow down."}).branch == "label"
    assert read(RequestKind("label", 1), 200, {}) == BAD_ANSWER


def test_pictures_are_all_there_or_none() -> None:
    picture = {"image": "iVBO", "codes": [0] * 98}
    assert read(RequestKind("imagine", 2), 200, {"pictures": [picture, picture]}).branch == "imagine"
    assert read(RequestKind("imagine", 2), 200, {"pictures": [picture]}) == BAD_ANSWER
    assert read(RequestKind("imagine", 1), 200, {"pictures": [{"codes": [0] * 98}]}) == BAD_ANSWER
