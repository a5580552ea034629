"""The inspector imagines: now, imagined, and what came, side by side; nothing where none is to be had."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from looktwice.model.driving.images import encode_png
from looktwice.model.driving.scene import NextFrame
from looktwice.model.driving.scene_store import write_scenes
from looktwice.service.operations.settings import Settings
from tests.service.scenes import labelled
from tests.service.scripted_engine import CARD, ScriptedEngine
from tests.service.serving import Served, serve

CAME = encode_png(np.full((112, 224, 3), (200, 40, 40), np.uint8))


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    path = tmp_path_factory.mktemp("scenes") / "scenes.parquet"
    write_scenes(path, [replace(labelled("slow-leader"), next_frames=(NextFrame("front_wide_120", CAME),))])
    with serve(ScriptedEngine(), Settings(bundled_scenes=path)) as running:
        yield running


def opened(page: Page, served: Served, *, imagines: bool) -> Page:
    formats = ("cf_vla", "vla_world") if imagines else ("cf_vla",)
    served.engine.card_shown = replace(CARD, formats=formats, paints=imagines)
    page.goto(served.url)
    expect(page.locator("#clips img")).to_have_count(2)
    return page


def test_what_is_imagined_stands_between_now_and_what_came(page: Page, served: Served) -> None:
    inspector = opened(page, served, imagines=True)
    panel = inspector.locator("#imagine-panel")
    assert panel.locator("figcaption").all_inner_texts() == ["now", "what came"]
    panel.get_by_role("button", name="Imagine").click()
    expect(panel.get_by_alt_text("front wide 120, imagined")).to_be_visible()
    assert panel.locator("figcaption").all_inner_texts() == ["now", "imagined", "what came"]
    assert panel.locator("img").evaluate_all(
        "images => Promise.all(images.map((each) => each.decode().then(() => each.naturalWidth)))"
    )[1:] == [224, 224]
    expect(panel).to_contain_text("5.0 m ahead")
    expect(panel.locator("#imagine-progress")).to_have_text(re.compile(r"^in \d+ ms$"))
    # Another camera, which the scene does not show and nobody recorded: only the imagined picture.
    panel.get_by_label("Camera").select_option("back_left")
    assert panel.locator("img").count() == 0
    panel.get_by_role("button", name="Imagine").click()
    expect(panel.get_by_alt_text("back left, imagined")).to_be_visible()
    assert served.engine.submitted[-1].controls.camera == "back_left"


def test_its_problems_are_told(page: Page, served: Served) -> None:
    inspector = opened(page, served, imagines=True)
    served.engine.card_shown = CARD
    inspector.get_by_role("button", name="Imagine").click()
    expect(inspector.get_by_role("alert")).to_contain_text("imagines in none of these")
    expect(inspector.locator("#imagine-progress")).to_have_text("No picture.")


def test_models_that_cannot_imagine_have_no_such_section(page: Page, served: Served) -> None:
    inspector = opened(page, served, imagines=False)
    expect(inspector.locator("#imagine-panel")).to_be_hidden()
