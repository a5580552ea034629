"""The inspector refines the chosen draw by the feedback that is shown, and judges what comes of it alike."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Locator, Page, Request, expect

from looktwice.model.bundled import CHECKPOINTS, SCENES
from looktwice.model.driving.scene_store import write_scenes
from looktwice.model.driving.trajectory import HALF_SECONDS_S
from looktwice.model.engines.engine import EngineError
from looktwice.model.engines.torch.engine import TorchEngine
from looktwice.service.operations.settings import Settings
from tests.browser.pages import (
    CHOSEN_RGB,
    EXPERT_RGB,
    INSIDE_OF_DOTS_RGB,
    colours_drawn_and_named,
    near,
    pixels,
    plan,
)
from tests.browser.test_feedback import WHY, WRONG_RGB
from tests.service.scenes import labelled
from tests.service.scripted_engine import CARD, ScriptedEngine
from tests.service.serving import Served, serve
from tests.sockets import PATIENCE_S

CUT_IN = "600009-0135"
"""Bundled: all draws of `elf-nano` hit a car there that cuts in, and refinements by feedback brake for it."""
PATIENCE_MS = 4 * PATIENCE_S * 1000


@pytest.fixture(scope="module")
def served() -> Iterator[Served[TorchEngine]]:
    with serve(TorchEngine(CHECKPOINTS["elf-nano"]), Settings(bundled_scenes=SCENES)) as running:
        # The process that scores begins with the first request.
        stand = {"scene_id": CUT_IN, "trajectories": [[[0.0, 0.0, 0.0]] * 8]}
        assert running.http.post("/v1/feedback", json=stand, timeout=4 * PATIENCE_S).status_code == 200
        yield running


def judged(page: Page, url: str, scene_id: str) -> Locator:
    """The page's feedback on the agreed one of two draws in a scene."""
    page.goto(url)
    page.get_by_label("Scene", exact=True).select_option(scene_id)
    expect(page.get_by_role("status")).to_contain_text(f"Scene {scene_id}")
    page.get_by_role("spinbutton", name="Draws").fill("2")
    page.get_by_label("Deadline, ms").fill("")
    plan(page)
    expect(page.locator("#draws tbody tr")).to_have_count(2, timeout=PATIENCE_MS)
    page.get_by_role("button", name=WHY).click()
    panel = page.locator("#feedback-panel")
    expect(panel.locator(".scores")).to_be_visible(timeout=PATIENCE_MS)
    return panel


def score_in(panel: Locator, heading: str) -> float:
    title = panel.get_by_role("heading", name=re.compile(heading))
    expect(title).to_be_visible(timeout=PATIENCE_MS)
    return float(title.inner_text().rpartition(" ")[2])


def sent_to(path: str, asked: list[Request]) -> Any:
    """The body of the one request that went there."""
    (request,) = (each for each in asked if each.url.endswith(path))
    return request.post_data_json


def test_a_wrong_draw_is_refined_by_the_feedback_that_is_shown(
    page: Page, served: Served[TorchEngine]
) -> None:
    panel = judged(page, served.url, CUT_IN)
    expect(page.locator('#timeline h3:text-is("Thoughts") + blockquote')).to_contain_text("Road edges: ")
    expect(page.get_by_role("button", name="Look twice")).to_be_hidden()
    before = score_in(panel, "^The plan is wrong: score")
    assert before < 0.8
    expect(panel.locator(".scores .bars i")).to_have_count(6)
    assert not near(pixels(page, "#birdseye"), CHOSEN_RGB).any(), "what is chosen is red"
    said = panel.get_by_text("Actionable correction:").locator("..").inner_text()

    asked: list[Request] = []
    page.on("request", lambda request: asked.append(request))

    def refine() -> None:
        page.get_by_role("button", name="Refine", exact=True).click()
        expect(page.get_by_role("status")).to_have_text(
            re.compile(r"^Refined in \d+ ms, request"), timeout=PATIENCE_MS
        )

    drawn, named = colours_drawn_and_named(page, refine)
    assert {WRONG_RGB, EXPERT_RGB, CHOSEN_RGB} <= drawn
    assert drawn - named == {INSIDE_OF_DOTS_RGB}
    after = score_in(panel, "^The refinement is correct: score")
    assert after > before + 0.5
    assert score_in(panel, "^The plan is wrong: score") == before
    expect(panel.locator(".scores .bars i")).to_have_count(12)
    expect(panel.locator(".scores dd").nth(1)).to_have_text(re.compile(r"^0\.00 → 1\.00$"))
    expect(panel.locator("blockquote")).to_contain_text("Road edges: ")
    expect(page.locator("#birdseye")).to_have_attribute(
        "aria-label", re.compile("the chosen one is wrong; its refinement ends .* and is correct")
    )
    shown = pixels(page, "#birdseye")
    for colour in (WRONG_RGB, EXPERT_RGB, CHOSEN_RGB):
        assert near(shown, colour).sum() > 20

    sent = sent_to("/v1/refine", asked)
    assert len(sent["draft"]) == 8
    assert sent["feedback"]["correction"] in said
    assert re.fullmatch("[0-9a-f]{12}", sent["feedback"]["plan_id"])
    # The refinement is judged as its draft was, by the labels of the scene.
    again = sent_to("/v1/feedback", asked)
    assert again["scene_id"] == CUT_IN
    assert len(again["trajectories"]) == 1

    page.locator("#draws input:not(:checked)").first.check()
    expect(page.get_by_role("button", name="Refine", exact=True)).to_be_hidden()
    expect(panel.locator(".scores")).to_have_count(0)
    assert "refinement" not in (page.locator("#birdseye").get_attribute("aria-label") or "")


@pytest.fixture
def scripted(tmp_path: Path) -> Iterator[Served]:
    path = tmp_path / "scenes.parquet"
    write_scenes(path, [labelled("slow-leader")])
    engine = ScriptedEngine()
    engine.times_s = HALF_SECONDS_S
    with serve(engine, Settings(bundled_scenes=path)) as running:
        yield running


def test_its_problems_are_told_and_it_may_be_tried_again(page: Page, scripted: Served) -> None:
    scripted.engine.card_shown = replace(CARD, formats=("cf_vla", "elf_vla_refine"))
    panel = judged(page, scripted.url, "slow-leader")
    button = panel.get_by_role("button", name="Refine", exact=True)
    scripted.engine.failure = EngineError("out of memory")
    button.click()
    expect(page.get_by_role("alert")).to_contain_text("The engine failed")
    expect(page.get_by_role("status")).to_have_text("No refinement.")
    scripted.engine.failure = None
    button.click()
    expect(panel.get_by_role("heading", name=re.compile("The refinement is"))).to_be_visible()
    expect(page.get_by_role("alert")).to_be_hidden()
    request = scripted.engine.submitted[-1]
    assert request.attempt is not None
    assert (request.format, request.controls.n) == ("elf_vla_refine", 1)


def test_a_model_that_refines_nothing_has_no_such_button(page: Page, scripted: Served) -> None:
    panel = judged(page, scripted.url, "slow-leader")
    expect(panel.get_by_role("button", name="Refine", exact=True)).to_be_hidden()
