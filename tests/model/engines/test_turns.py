from __future__ import annotations

from typing import Any

import pytest

from model.engines.engine import Controls, PlanRequest
from model.engines.torch.pace import Pace
from model.engines.torch.rows import Request
from model.engines.torch.turns import Work, turn
from tests.checkpoints import noisy_scene


def work(name: str, deadline_ms: int | None, passes: float = 10, rows: int = 2, prompts: int = 0) -> Work:
    asked = PlanRequest(name, noisy_scene(0), "cf_vla", Controls(deadline_ms=deadline_ms))
    nothing: Any = None  # where it begins is of no account here
    return Work(Request(asked, nothing, 0.0, ord(name[0])), passes, rows, prompts)


class Known(Pace):
    """A prompt takes 100 ms, and a pass 10 ms and 5 ms a row."""

    def __init__(self) -> None:
        super().__init__()
        self.prompt_s = 0.1

    def pass_s(self, rows: int) -> float:
        return 0.01 + 0.005 * rows


def names(works: list[Work], now_s: float = 0.0) -> str:
    return "".join(request.id for request in turn(works, Known(), now_s))


def test_without_deadlines_all_go_on_in_order_of_arrival() -> None:
    assert names([work("b", None), work("a", None), work("c", None)]) == "abc"


def test_without_requests_nobody_goes_on() -> None:
    assert names([]) == ""


def test_all_go_on_where_the_most_urgent_has_time_enough() -> None:
    assert names([work("a", 2000), work("b", 1000), work("c", None)]) == "bac"


def test_as_many_go_on_as_leave_the_most_urgent_its_time() -> None:
    # Beside one other it needs ten passes of 30 ms, beside two of 40 ms; a quarter more is left to it.
    assert names([work("a", 2000), work("b", 400), work("c", None)]) == "ba"
    assert names([work("a", 2000), work("b", 300), work("c", None)]) == "b"


def test_prompts_count_of_all_that_go_on() -> None:
    assert names([work("a", 500), work("b", None, prompts=1)]) == "ab"
    assert names([work("a", 450), work("b", None, prompts=1)]) == "a"


def test_who_cannot_be_in_time_any_more_makes_nobody_late() -> None:
    assert names([work("a", 150), work("b", 300), work("c", 350)]) == "b"
    assert names([work("a", 150), work("b", None)]) == "ab"


def test_a_second_look_waits_for_those_that_have_nothing_yet() -> None:
    assert names([work("a", 250, passes=0), work("b", 300)]) == "b"
    assert names([work("a", 250, passes=0), work("b", 3000)]) == "ba"
    assert names([work("a", 250, passes=0)]) == "a"


def test_who_waits_long_comes_first_after_all() -> None:
    assert names([work("a", None), work("b", 4_300)], now_s=4.0) == "ab"


def test_what_passes_take_is_learnt_from_those_of_different_sizes() -> None:
    pace = Pace()
    for number in range(2000):
        rows = 1 + number % 30
        pace.saw_pass(0.02 + 0.001 * rows, rows)
    assert pace.pass_s(1) == pytest.approx(0.021, rel=0.01)
    assert pace.pass_s(60) == pytest.approx(0.08, rel=0.01)


def test_passes_that_are_all_alike_tell_nothing_of_rows() -> None:
    pace = Pace()
    for _ in range(2000):
        pace.saw_pass(0.03, 6)
    assert pace.pass_s(6) == pytest.approx(0.03, rel=0.01)
    assert pace.pass_s(60) == pytest.approx(0.03, rel=0.1)


def test_a_prompt_takes_as_long_as_its_parts() -> None:
    pace = Pace()
    for _ in range(100):
        pace.saw_prompts(0.05, 0)
        pace.saw_prompts(0.15, 2)
    assert pace.prompt_s == pytest.approx(0.1, rel=0.01)


def test_the_longer_responses_count() -> None:
    alike, varying = Pace(), Pace()
    for number in range(200):
        alike.saw_direct(14)
        varying.saw_direct(10 if number % 2 else 18)
    assert alike.direct_passes_left(4) == pytest.approx(10, abs=0.1)
    assert varying.direct_passes_left(4) == pytest.approx(18, abs=1)
    assert alike.direct_passes_left(50) == 1
