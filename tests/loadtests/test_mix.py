from __future__ import annotations

from collections import Counter

import pytest

from looktwice.loadtests.mix import Mix, RequestKind, parse_mix, parse_weights


def test_choices_occur_as_often_as_they_weigh() -> None:
    mix = parse_mix("direct=3,think=1", "1,6", "json=9,msgpack=1", "none=1,300=1", 0.25)
    kinds = mix.kinds(8000, seed=5)
    assert Counter(kind.work for kind in kinds)["think"] == pytest.approx(2000, rel=0.1)
    assert Counter(kind.n for kind in kinds)[6] == pytest.approx(4000, rel=0.1)
    assert Counter(kind.payload for kind in kinds)["msgpack"] == pytest.approx(800, rel=0.2)
    assert Counter(kind.deadline_ms for kind in kinds)[300] == pytest.approx(4000, rel=0.1)
    assert Counter(kind.stream for kind in kinds)[True] == pytest.approx(2000, rel=0.1)
    assert kinds == mix.kinds(8000, seed=5) != mix.kinds(8000, seed=6)


def test_labels_and_batches_do_not_stream() -> None:
    kinds = parse_mix("label,batch", "6", "json", "300", 1.0).kinds(50, seed=0)
    assert set(kinds) == {RequestKind("label", 1), RequestKind("batch", 6, deadline_ms=300)}
    pictures = parse_mix("imagine", "2", "json", "300", 1.0).kinds(5, seed=0)
    assert set(pictures) == {RequestKind("imagine", 2, stream=True)}
    with pytest.raises(ValueError, match="no deadline"):
        RequestKind("imagine", deadline_ms=300)
    with pytest.raises(ValueError, match="no stream"):
        RequestKind("batch", stream=True)


@pytest.mark.parametrize(
    "text", ["plan,plan", "sprint", "plan=-1", "plan=0", "plan=inf", "plan=nan", "plan=much", ""]
)
def test_a_mix_that_means_nothing_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        parse_mix(text, "6", "json", "none", 0)


def test_kinds_stay_within_the_contract() -> None:
    for wrong in ({"n": 0}, {"n": 65}, {"deadline_ms": 0}):
        with pytest.raises(ValueError, match=str(next(iter(wrong.values())))):
            RequestKind(**wrong)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="share"):
        Mix(stream=1.5)


def test_weights_default_to_one() -> None:
    assert parse_weights("1, 6=2.5", int) == {1: 1.0, 6: 2.5}


def test_kinds_tell_what_they_are() -> None:
    assert str(RequestKind("think", 6, "msgpack", True, 300)) == "think n=6 msgpack stream within 300 ms"
    assert str(RequestKind("label", 1)) == "label json"
