"""What tests of the inspector page do again and again, and the colours that they look for."""

from __future__ import annotations

import io
import re
from collections.abc import Callable

import numpy as np
from PIL import Image
from playwright.sync_api import Page

CHOSEN_RGB = (29, 95, 209)  # --chosen of the light theme
EXPERT_RGB = (22, 128, 60)  # --expert of the light theme
DRAFT_RGB = (194, 24, 127)  # --draft of the light theme
DARK_PAGE_RGB = (18, 22, 28)  # --page of the dark theme
INSIDE_OF_DOTS_RGB = (255, 255, 255)  # --panel of the light theme
RGB = tuple[int, int, int]


def plan(page: Page) -> None:
    page.get_by_role("button", name="Plan", exact=True).click()


def pixels(page: Page, selector: str) -> np.ndarray:
    encoded = page.locator(selector).screenshot()
    return np.asarray(Image.open(io.BytesIO(encoded)).convert("RGB"))


def near(image: np.ndarray, rgb: RGB) -> np.ndarray:
    found: np.ndarray = np.abs(image.astype(int) - rgb).max(axis=-1) < 12
    return found


def colours_drawn_and_named(page: Page, redraws: Callable[[], None]) -> tuple[set[RGB], set[RGB]]:
    """What the bird's-eye view is drawn in when ``redraws`` is called, and what its legend names."""
    page.evaluate(
        """() => {
          window.drawn = new Set();
          const pens = CanvasRenderingContext2D.prototype;
          for (const [draw, style] of [["stroke", "strokeStyle"], ["fill", "fillStyle"]]) {
            const own = pens[draw];
            pens[draw] = function (...given) {
              window.drawn.add(this[style]);
              return own.apply(this, given);
            };
          }
        }"""
    )
    redraws()
    drawn = {
        (int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16))
        for text in page.evaluate("[...window.drawn]")
    }
    named = page.evaluate(
        """() => [...document.querySelectorAll(".legend li")].flatMap((item) => {
          const style = getComputedStyle(item, "::before");
          return [style.borderTopColor, style.backgroundColor];
        })"""
    )
    numbers = [[int(number) for number in re.findall(r"\d+", text)] for text in named]
    return drawn, {(red, green, blue) for red, green, blue, *_ in numbers}
