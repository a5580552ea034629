from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageDraw

from looktwice.clients.summaries.lettering import font, wrap, write_in_box

WHITE, BLACK = (255, 255, 255), (0, 0, 0)
texts = st.text(st.sampled_from("abW .,0\n"), max_size=120)


@given(texts, st.integers(9, 17), st.integers(60, 300))
def test_lines_fit_and_hold_all_that_was_said(text: str, size_px: int, width_px: int) -> None:
    lines = wrap(text, size_px, width_px)
    assert "".join("".join(lines).split()) == "".join(text.split())
    for line in lines:
        if len(line.strip()) > 1:
            assert font(size_px).getlength(line) <= width_px


def test_lines_break_between_words_and_keep_their_indentation() -> None:
    width_px = round(font(12).getlength("  one two"))
    assert wrap("first\n  one two three", 12, width_px) == ["first", "  one two", "  three"]


@pytest.mark.parametrize("words", [3, 60, 2000])
def test_nothing_is_written_outside_the_box(words: int) -> None:
    image = Image.new("RGB", (300, 200), WHITE)
    box = (40, 30, 260, 170)
    write_in_box(ImageDraw.Draw(image), box, [("heading", BLACK), ("", BLACK), ("going " * words, BLACK)], 17)
    inked = np.argwhere(np.asarray(image).min(axis=2) < 255)
    top, left = inked.min(axis=0)
    bottom, right = inked.max(axis=0)
    assert (left, top) >= (40, 30)
    assert right < 260
    assert bottom < 170
