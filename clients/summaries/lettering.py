"""Text in pictures that never leaves its box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from PIL import ImageDraw, ImageFont

Font = ImageFont.FreeTypeFont | ImageFont.ImageFont
Colour = tuple[int, int, int]

_LEADING_PX: Final = 4
_SMALLEST_PX: Final = 9


def font(size_px: int) -> Font:
    """Pillow's own font."""
    return ImageFont.load_default(size=size_px)


def line_height(size_px: int) -> int:
    """Pixels from line to line."""
    return size_px + _LEADING_PX


def wrap(text: str, size_px: int, width_px: int) -> list[str]:
    """Break text into lines of at most ``width_px``, between words where it can be.

    Line breaks and the indentation of lines stay; what a line goes on with is indented as the line is.
    """
    letters, lines = font(size_px), list[str]()
    for paragraph in text.splitlines():
        indent = paragraph[: len(paragraph) - len(paragraph.lstrip())]
        line = indent
        for word in paragraph.split():
            longer = f"{line} {word}" if line.strip() else indent + word
            if letters.getlength(longer) > width_px and line.strip():
                lines.append(line)
                longer = indent + word
            while letters.getlength(longer) > width_px and len(longer) > len(indent) + 1:
                fits = max(
                    (end for end in range(len(longer)) if letters.getlength(longer[:end]) <= width_px),
                    default=0,
                )
                end = max(fits, len(indent) + 1)
                lines.append(longer[:end])
                longer = indent + longer[end:]
            line = longer
        lines.append(line)
    return lines


def write_in_box(
    draw: ImageDraw.ImageDraw,
    box: tuple[int, int, int, int],
    paragraphs: Sequence[tuple[str, Colour]],
    size_px: int,
) -> None:
    """Write paragraphs one below another, smaller where they would not fit; the rest is cut with an ellipsis.

    Args:
        draw: of the picture.
        box: left, top, right and bottom in pixels.
        paragraphs: texts and their colours; an empty text leaves a line free.
        size_px: of the letters, at most.
    """
    left, top, right, bottom = box
    for size in range(size_px, _SMALLEST_PX - 1, -1):
        lines = [
            (line, colour) for text, colour in paragraphs for line in wrap(text, size, right - left) or [""]
        ]
        room = (bottom - top) // line_height(size)
        if len(lines) <= room:
            break
    if len(lines) > room:
        lines = [*lines[: room - 1], ("…", lines[room - 1][1])]
    for row, (line, colour) in enumerate(lines):
        draw.text((left, top + row * line_height(size)), line, fill=colour, font=font(size))
