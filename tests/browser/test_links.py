"""Links to plans on the inspector page."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from playwright.sync_api import Page, expect

from looktwice.model.driving.scene_store import write_scenes
from looktwice.model.engines.engine import EngineError
from tests.browser.pages import plan
from tests.service.scenes import labelled
from tests.service.scripted_engine import SLOW_DOWN, ScriptedEngine
from tests.service.serving import Served


def test_a_link_leads_to_the_same_plan(inspector: Page, served: Served, engine: ScriptedEngine) -> None:
    inspector.get_by_label("Scene", exact=True).select_option("second/scene")
    expect(inspector.get_by_role("status")).to_contain_text("second/scene")
    inspector.get_by_label("Seed").fill("77")
    inspector.get_by_role("spinbutton", name="Draws").fill("2")
    plan(inspector)
    link = link_to_this_plan(inspector)
    (asked,) = engine.submitted
    inspector.goto("about:blank")
    inspector.goto(link)
    expect(inspector.locator("#draws tbody tr")).to_have_count(2)
    again = engine.submitted[-1]
    assert again.scene.scene_id == "second/scene"
    assert (again.controls.seed, again.controls.n) == (asked.controls.seed, asked.controls.n) == (77, 2)
    inspector.goto("about:blank")
    inspector.goto(f"{served.url}/#scene=nowhere")
    expect(inspector.get_by_role("alert")).to_contain_text("not here")


def link_to_this_plan(page: Page) -> str:
    link = page.get_by_role("link", name="Link to this plan").get_attribute("href")
    assert link is not None
    return link


def test_a_link_says_whether_route_and_tracks_are_given(
    page: Page, served: Served, engine: ScriptedEngine
) -> None:
    plain = engine.card_shown
    engine.card_shown = replace(plain, inputs=("route", "tracks"))
    try:
        page.goto(served.url)
        page.get_by_label("give the route").uncheck()
        page.get_by_label("give the tracks").check()
        plan(page)
        expect(page.locator("#draws tbody tr")).to_have_count(6)
        link = link_to_this_plan(page)
        page.goto("about:blank")
        engine.submitted.clear()
        page.goto(link)
        expect(page.locator("#draws tbody tr")).to_have_count(6)
        (again,) = engine.submitted
        assert again.scene.route is None
        assert again.scene.tracks
    finally:
        engine.card_shown = plain


def test_a_link_leads_to_the_second_look_that_is_shown(inspector: Page, engine: ScriptedEngine) -> None:
    plan(inspector)
    expect(inspector.locator("#draws tbody tr")).to_have_count(6)
    first = link_to_this_plan(inspector)
    inspector.get_by_label("A plan to look at twice").fill(str(SLOW_DOWN))
    inspector.get_by_label("Thinking", exact=True).select_option("always")
    inspector.get_by_role("spinbutton", name="Draws").fill("3")
    inspector.get_by_role("button", name="Look twice").click()
    expect(inspector.locator("#draws tbody tr")).to_have_count(3)
    link = link_to_this_plan(inspector)
    assert inspector.url == link != first
    engine.submitted.clear()
    inspector.goto("about:blank")
    inspector.goto(link)
    expect(inspector.locator("#draws tbody tr")).to_have_count(3)
    again = engine.submitted[0].controls
    assert (again.prefill, again.thinking, again.n) == (SLOW_DOWN, "always", 3)
    engine.failure = EngineError("broke")
    plan(inspector)
    expect(inspector.get_by_role("alert")).to_be_visible()
    engine.failure = None
    assert link_to_this_plan(inspector) == inspector.url == link, "the second look is still what is shown"


def test_there_is_no_link_where_another_scene_is_shown(
    inspector: Page, served: Served, tmp_path: Path
) -> None:
    plan(inspector)
    expect(inspector.locator("#link")).to_be_visible()
    inspector.get_by_label("Scene", exact=True).select_option("second/scene")
    expect(inspector.get_by_role("status")).to_contain_text("second/scene")
    expect(inspector.locator("#link")).to_be_hidden()
    expect(inspector).to_have_url(f"{served.url}/")
    plan(inspector)
    expect(inspector.locator("#link")).to_be_visible()
    write_scenes(tmp_path / "mine.parquet", [labelled("mine")])
    inspector.get_by_label("Open a scene file").set_input_files(tmp_path / "mine.parquet")
    expect(inspector.get_by_role("status")).to_contain_text("mine")
    plan(inspector)
    expect(inspector.locator("#draws tbody tr")).to_have_count(6)
    expect(inspector.locator("#link")).to_be_hidden()
    expect(inspector).to_have_url(f"{served.url}/")


def test_a_link_is_followed_on_the_page_that_is_open(inspector: Page, engine: ScriptedEngine) -> None:
    inspector.get_by_label("Use a think threshold").check()
    inspector.get_by_label("Scene", exact=True).select_option("second/scene")
    expect(inspector.get_by_role("status")).to_contain_text("second/scene")
    inspector.get_by_role("spinbutton", name="Draws").fill("2")
    plan(inspector)
    expect(inspector.locator("#draws tbody tr")).to_have_count(2)
    engine.submitted.clear()
    other = "scene=slow-leader&thinking=always&n=3&seed=5&with-route=false"
    inspector.evaluate("link => { location.hash = link; }", other)
    expect(inspector.locator("#draws tbody tr")).to_have_count(3)
    (asked,) = engine.submitted
    assert asked.scene.scene_id == "slow-leader"
    assert asked.scene.route is None
    controls = asked.controls
    assert (controls.thinking, controls.n, controls.seed) == ("always", 3, 5)
    assert controls.think_threshold is None
    inspector.evaluate("() => { location.hash = 'scene=nowhere'; }")
    expect(inspector.get_by_role("alert")).to_contain_text("not here")
    expect(inspector.get_by_label("Scene", exact=True)).to_have_value("slow-leader")
