"""The inspector's feedback: which draw is wrong, why, and what a second look made of it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from looktwice.model.driving.scene_store import write_scenes
from looktwice.model.driving.trajectory import TEN_HZ_S
from looktwice.service.operations.settings import Settings
from tests.browser.pages import (
    EXPERT_RGB,
    INSIDE_OF_DOTS_RGB,
    colours_drawn_and_named,
    near,
    pixels,
    plan,
)
from tests.service.scenes import labelled
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served, serve
from tests.sockets import PATIENCE_S

WRONG_RGB = (211, 32, 32)  # --wrong of the light theme
WHY = "Is it right, and why?"


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    path = tmp_path_factory.mktemp("scenes") / "scenes.parquet"
    write_scenes(path, [labelled("slow-leader")])
    with serve(ScriptedEngine(), Settings(bundled_scenes=path)) as running:
        # The process that scores begins with the first request.
        stand = {"scene_id": "slow-leader", "trajectories": [[[0.0, 0.0, 0.0]] * 8]}
        begun = running.http.post("/v1/feedback", json=stand, timeout=4 * PATIENCE_S)
        assert begun.status_code == 200
        yield running


@pytest.fixture
def inspector(page: Page, served: Served) -> Page:
    page.goto(served.url)
    expect(page.locator("#clips img")).to_have_count(2)
    return page


def test_a_wrong_first_plan_is_red_and_told_why_beside_what_came_of_it(inspector: Page) -> None:
    expect(inspector.get_by_role("button", name=WHY)).to_be_hidden()
    inspector.get_by_label("Thinking", exact=True).select_option("always")
    plan(inspector)
    before = pixels(inspector, "#birdseye")
    assert not near(before, WRONG_RGB).any()
    inspector.get_by_role("button", name=WHY).click()
    panel = inspector.locator("#feedback-panel")
    expect(panel.get_by_role("heading", name=re.compile("First plan is wrong: score 0"))).to_be_visible(
        timeout=PATIENCE_S * 1000
    )
    expect(panel.get_by_role("heading", name=re.compile("After the second look is"))).to_be_visible()
    expect(panel).to_contain_text("Actionable correction:")
    expect(panel).to_contain_text("the vehicle #1")
    # Five sub-scores that count and one that does not, each before and after.
    expect(panel.locator(".scores dt")).to_have_count(6)
    expect(panel.locator(".scores .bars i")).to_have_count(12)
    collisions = panel.locator(".scores dd").nth(1)
    expect(collisions).to_have_text(re.compile(r"^0\.00 → "))
    expect(inspector.locator("#birdseye")).to_have_attribute("aria-label", re.compile("by its score"))
    after = pixels(inspector, "#birdseye")
    assert near(after, WRONG_RGB).any()
    assert near(after, EXPERT_RGB).sum() > near(before, EXPERT_RGB).sum()


@pytest.mark.parametrize("thinking", ["always", "never"])
def test_the_legend_names_every_colour_of_a_draw_that_is_judged(inspector: Page, thinking: str) -> None:
    inspector.get_by_label("Thinking", exact=True).select_option(thinking)
    plan(inspector)
    expect(inspector.locator("#draws tbody tr")).to_have_count(6)

    def judge() -> None:
        inspector.get_by_role("button", name=WHY).click()
        expect(inspector.locator("#birdseye")).to_have_attribute(
            "aria-label", re.compile("by its score"), timeout=PATIENCE_S * 1000
        )

    drawn, named = colours_drawn_and_named(inspector, judge)
    assert WRONG_RGB in drawn
    assert EXPERT_RGB in drawn
    assert drawn - named == {INSIDE_OF_DOTS_RGB}


def test_feedback_is_of_the_chosen_draw_only(inspector: Page, served: Served) -> None:
    inspector.get_by_label("Thinking", exact=True).select_option("never")
    plan(inspector)
    inspector.get_by_role("button", name=WHY).click()
    panel = inspector.locator("#feedback-panel")
    expect(panel.get_by_role("heading", name=re.compile("The plan is (wrong|correct)"))).to_be_visible(
        timeout=PATIENCE_S * 1000
    )
    inspector.locator("#draws input:not(:checked)").first.check()
    expect(panel.locator(".scores")).to_have_count(0)
    assert not near(pixels(inspector, "#birdseye"), WRONG_RGB).any()
    served.engine.times_s = tuple(round(0.2 * place, 1) for place in range(1, 33))
    try:
        plan(inspector)
        expect(inspector.get_by_role("button", name=WHY)).to_be_hidden()
    finally:
        served.engine.times_s = TEN_HZ_S


def test_of_an_opened_file_nothing_is_asked(inspector: Page, served: Served, tmp_path: Path) -> None:
    file = tmp_path / "own.json"
    file.write_text(served.http.get("/v1/scenes/slow-leader").text.replace("slow-leader", "own"))
    inspector.get_by_label("Open a scene file").set_input_files(file)
    expect(inspector.get_by_role("status")).to_contain_text("Scene own")
    plan(inspector)
    expect(inspector.locator("#draws tbody tr")).to_have_count(6)
    expect(inspector.get_by_role("button", name=WHY)).to_be_hidden()
