from __future__ import annotations

import contextlib
import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.plan import (
    GROUPS,
    TICKS,
    WORDS,
    Group,
    MetaAction,
    Plan,
    PlanError,
    Track,
    parse_plan,
    plan_changes,
    plan_from_bins,
    plan_iou,
)

PAPERS_EXAMPLE = """\
- longitudinal
  - 0.0s-0.9s: Keep Speed
  - 0.9s-6.4s: Accelerate
- lateral
  - 0.0s-6.4s: Straight
- lane
  - 0.0s-4.4s: Left Lane Change
  - 4.4s-6.4s: Keep Lane
"""


@st.composite
def tracks(draw: st.DrawFn, group: Group, joined: bool = False) -> Track:
    """Any partition of the horizon; ``joined``: no two neighbours with the same word."""
    cuts = sorted(draw(st.sets(st.integers(1, TICKS - 1), max_size=10)))
    edges = [0, *cuts, TICKS]
    actions: list[MetaAction] = []
    for start, end in itertools.pairwise(edges):
        allowed = [word for word in WORDS[group] if not (joined and actions and word == actions[-1].word)]
        actions.append(MetaAction(start, end, draw(st.sampled_from(allowed))))
    return tuple(actions)


def plans(joined: bool = False) -> st.SearchStrategy[Plan]:
    """Any plan with at least one group."""
    return st.builds(Plan, **{group: st.none() | tracks(group, joined) for group in GROUPS}).filter(
        lambda plan: bool(plan.tracks())
    )


# The text


def test_the_papers_example_is_read_and_written() -> None:
    plan = parse_plan(PAPERS_EXAMPLE)
    assert plan.longitudinal == (MetaAction(0, 9, "Keep Speed"), MetaAction(9, 64, "Accelerate"))
    assert plan.word_at("lane", 43) == "Left Lane Change"
    assert plan.word_at("lane", 44) == "Keep Lane"
    assert str(plan) == PAPERS_EXAMPLE


@given(plans())
def test_text_round_trip(plan: Plan) -> None:
    assert parse_plan(str(plan)) == plan
    assert parse_plan(str(plan).removesuffix("\n")) == plan


@given(plans(joined=True))
def test_bins_round_trip(plan: Plan) -> None:
    assert plan_from_bins(plan.bins()) == plan


@given(plans())
def test_bins_and_words_agree(plan: Plan) -> None:
    bins = plan.bins()
    for row, group in zip(bins, GROUPS, strict=True):
        for tick in range(TICKS):
            word = plan.word_at(group, tick)
            assert row[tick] == (-1 if word is None else WORDS[group].index(word))


@given(plans())
def test_a_mirror_exchanges_left_and_right_twice(plan: Plan) -> None:
    assert plan.mirrored().mirrored() == plan
    assert str(plan.mirrored()).count("Left") == str(plan).count("Right")
    assert plan.mirrored().longitudinal == plan.longitudinal


LATERAL = "- lateral\n  - 0.0s-6.4s: Straight\n"


@pytest.mark.parametrize(
    ("text", "line", "column", "message"),
    [
        ("- lateral\n  - 0.0s-2.0s: Straight\n  - 2.5s-6.4s: Left Turn\n", 3, 5, "gap before"),
        ("- lateral\n  - 0.0s-2.0s: Straight\n  - 1.9s-6.4s: Left Turn\n", 3, 5, "overlaps"),
        ("- lateral\n  - 0.5s-6.4s: Straight\n", 2, 5, "gap before"),
        ("- lateral\n  - 0.0s-6.4s: Sideways\n", 2, 16, "unknown lateral word 'Sideways'"),
        ("- lateral\n  - 0.0s-6.4s: straight\n", 2, 16, "unknown lateral word"),
        ("- lateral\n  - 0.0s-6.4s: Straight \n", 2, 16, "unknown lateral word"),
        ("- lateral\n  - 0.0s-6.4s: Keep Lane\n", 2, 16, "unknown lateral word"),
        ("- lateral\n  - 0.0s-6.0s: Straight\n", 2, 24, "ends at 6.0s, not at 6.4s"),
        ("- lateral\n  - 0.0s-6.5s: Straight\n", 2, 5, "outside 0.0s-6.4s"),
        ("- lateral\n  - 0.0s-0.0s: Straight\n", 2, 5, "does not end after it starts"),
        ("- lateral\n  - 0.0s-3.25s: Straight\n", 2, 10, "'3.25' is not a time on the 0.1 s grid"),
        ("- lateral\n  - 0s-6.4s: Straight\n", 2, 5, "'0' is not a time"),
        ("- lateral\n  - 00.0s-6.4s: Straight\n", 2, 5, "'00.0' is not a time"),
        ("- lateral\n  - 0.0s-٦.٤s: Straight\n", 2, 10, "is not a time"),
        ("- lateral\n  - 0.0s-" + "9" * 5000 + ".0s: Straight\n", 2, 10, "is not a time"),
        ("- lateral\n  - -0.1s-6.4s: Straight\n", 2, 5, "is not a time"),
        (LATERAL + "- longitudinal\n  - 0.0s-6.4s: Wait\n", 3, 3, "longitudinal after lateral"),
        (LATERAL + LATERAL, 3, 3, "lateral after lateral"),
        ("- sideways\n  - 0.0s-6.4s: Straight\n", 1, 3, "unknown group 'sideways'"),
        ("- lateral\n" + "- lane\n  - 0.0s-6.4s: Keep Lane\n", 1, 10, "has no meta-actions"),
        ("- lateral\n", 1, 10, "has no meta-actions"),
        ("  - 0.0s-6.4s: Straight\n", 1, 1, "before any group"),
        ("- lateral\n    - 0.0s-6.4s: Straight\n", 2, 1, "expected '- group'"),
        ("- lateral\n\n  - 0.0s-6.4s: Straight\n", 2, 1, "an empty line"),
        ("Meta Actions:\n" + LATERAL, 1, 1, "found 'Meta Actions:'"),
        ("", 1, 1, "an empty line"),
    ],
)
def test_every_break_of_the_rules_names_line_and_column(
    text: str, line: int, column: int, message: str
) -> None:
    with pytest.raises(PlanError) as caught:
        parse_plan(text)
    assert (caught.value.line, caught.value.column) == (line, column)
    assert message in caught.value.message
    assert str(caught.value).startswith(f"line {line}, column {column}: ")


def test_lines_count_from_where_the_plan_stands_in_a_larger_text() -> None:
    with pytest.raises(PlanError, match="line 12, column 24"):
        parse_plan("- lateral\n  - 0.0s-6.0s: Straight", first_line=11)


@given(st.text("- lateralongitudn\n0123456.s: StrkepLKT", max_size=80))
def test_any_text_is_a_plan_or_a_plan_error(text: str) -> None:
    with contextlib.suppress(PlanError):
        parse_plan(text)


def test_a_plan_cannot_be_built_against_the_rules() -> None:
    with pytest.raises(PlanError, match=r"ends at 6\.0s"):
        Plan(lane=(MetaAction(0, 60, "Keep Lane"),))
    with pytest.raises(PlanError, match="leave the group out"):
        Plan(lane=())


# IOU


def slow_iou(one: Plan, other: Plan) -> float:
    """Sets of (group, tick, word) triples, as the definition says."""

    def triples(plan: Plan) -> set[tuple[str, int, str]]:
        return {
            (group, tick, action.word)
            for group, track in plan.tracks()
            for action in track
            for tick in range(action.start, action.end)
        }

    a, b = triples(one), triples(other)
    return len(a & b) / len(a | b) if a | b else 1.0


@given(plans(), plans())
def test_iou_equals_the_slow_one(one: Plan, other: Plan) -> None:
    assert plan_iou(one, other) == pytest.approx(slow_iou(one, other))
    assert plan_iou(one, other) == plan_iou(other, one)
    assert plan_iou(one, one) == 1.0


def test_iou_by_hand() -> None:
    one = Plan(lateral=(MetaAction(0, 32, "Straight"), MetaAction(32, 64, "Left Turn")))
    other = Plan(lateral=(MetaAction(0, 64, "Straight"),))
    assert plan_iou(one, other) == pytest.approx(32 / 96)
    assert plan_iou(Plan(), other) == 0.0
    assert plan_iou(Plan(), Plan()) == 1.0


def test_changes_say_where_plans_differ() -> None:
    one = parse_plan("- longitudinal\n  - 0.0s-2.0s: Wait\n  - 2.0s-6.4s: Accelerate\n")
    other = parse_plan(
        "- longitudinal\n  - 0.0s-3.0s: Wait\n  - 3.0s-6.4s: Accelerate\n- lane\n  - 0.0s-6.4s: Keep Lane\n"
    )
    assert plan_changes(one, one) == []
    assert plan_changes(one, other) == [
        ("longitudinal", 20, 30, "Accelerate", "Wait"),
        ("lane", 0, 64, None, "Keep Lane"),
    ]
    assert [change[3:] for change in plan_changes(other, one)] == [
        ("Wait", "Accelerate"),
        ("Keep Lane", None),
    ]
