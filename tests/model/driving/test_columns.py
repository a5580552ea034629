from __future__ import annotations

from looktwice.model.driving.columns import Columns, aligned, cell, cells, interval_cell, titles

COLUMNS: Columns = {"ade_m": ("ADE m", "{:.2f}"), "share": ("share", "{:.1%}")}


def test_figures_stand_below_their_titles_with_their_intervals() -> None:
    rows = [
        ["a", *cells(COLUMNS, {"ade_m": 1.0, "share": None}, {"ade_m": (0.5, 1.25)}, {"ade_m"})],
        ["long name", *cells(COLUMNS, {"ade_m": 12.345, "share": 0.5}, {"ade_m": None}, {"ade_m"})],
    ]
    assert aligned([["", *titles(COLUMNS, {"ade_m"})], *rows]) == [
        "           ADE m        95 %  share",
        "a           1.00  0.50..1.25      -",
        "long name  12.35              50.0%",
    ]


def test_missing_figures_and_intervals_are_told_apart_from_zero() -> None:
    assert (cell(None, "{:.1f}"), cell(0.0, "{:.1f}")) == ("-", "0.0")
    assert (interval_cell(None, "{:.1f}"), interval_cell((0.0, 0.0), "{:.1f}")) == ("", "0.0..0.0")


def test_more_than_one_column_may_stand_to_the_left() -> None:
    assert aligned([["a", "b", "c"], ["long", "long", "long"]], left=2) == [
        "a     b        c",
        "long  long  long",
    ]
    assert aligned([]) == []
