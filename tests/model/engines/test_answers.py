from __future__ import annotations

from model.engines.torch.answers import Answers


def test_every_draw_has_its_own_last_answer() -> None:
    answers = Answers()
    answers.keep(b"scene", (0, 2), [1, 2, 3])
    answers.keep(b"scene", (1,), [1, 5])
    answers.keep(b"scene", (2,), [9])
    assert [answers.last(b"scene", draw) for draw in range(4)] == [(1, 2, 3), (1, 5), (9,), ()]
    assert answers.last(b"other", 0) == ()


def test_the_oldest_scenes_are_forgotten() -> None:
    answers = Answers()
    for number in range(257):
        answers.keep(str(number).encode(), (0,), [number])
    assert answers.last(b"0", 0) == ()
    assert answers.last(b"256", 0) == (256,)
