"""The inspector page in a real Chromium, against a real server."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, expect

from looktwice.model.driving.scene_store import write_scenes
from looktwice.model.driving.trajectory import TEN_HZ_S
from looktwice.model.engines.engine import EngineError
from looktwice.service.operations.keys import new_line
from looktwice.service.operations.settings import Settings
from tests.browser.pages import (
    CHOSEN_RGB,
    DARK_PAGE_RGB,
    DRAFT_RGB,
    EXPERT_RGB,
    INSIDE_OF_DOTS_RGB,
    colours_drawn_and_named,
    near,
    pixels,
    plan,
)
from tests.service.scenes import labelled
from tests.service.scripted_engine import CARD, KEEP_ON, REASONING, SLOW_DOWN, ScriptedEngine
from tests.service.serving import Served, serve


def test_a_service_with_keys_asks_the_browser_for_one(
    browser: Browser, engine: ScriptedEngine, tmp_path: Path
) -> None:
    key, line = new_line("operator")
    (tmp_path / "keys").write_text(line)
    path = tmp_path / "scenes.parquet"
    write_scenes(path, [labelled("slow-leader")])
    settings = Settings(bundled_scenes=path, api_keys_file=tmp_path / "keys")
    with serve(ScriptedEngine(), settings, headers={"Authorization": f"Bearer {key}"}) as served:
        context = browser.new_context(http_credentials={"username": "me", "password": key})
        page = context.new_page()
        page.goto(served.url)
        expect(page.locator("#clips img")).to_have_count(2)
        plan(page)
        expect(page.locator("#draws tbody tr")).to_have_count(6)
        context.close()


def test_shows_a_scene_before_anything_is_asked(inspector: Page, engine: ScriptedEngine) -> None:
    expect(inspector.locator("#model")).to_contain_text("scripted r1")
    expect(inspector.get_by_label("Scene", exact=True)).to_have_value("slow-leader")
    expect(inspector.locator("#tags")).to_contain_text("lead vehicle")
    expect(inspector.get_by_role("img", name="front_wide_120, now")).to_be_visible()
    expect(inspector.locator("#birdseye")).to_have_attribute(
        "aria-label", "The scene from above with 3 agents"
    )
    assert engine.submitted == []


def test_plans_with_the_controls(inspector: Page, engine: ScriptedEngine) -> None:
    inspector.get_by_label("Thinking", exact=True).select_option("always")
    inspector.get_by_role("spinbutton", name="Draws").fill("3")
    inspector.get_by_label("Temperature").fill("0.5")
    inspector.get_by_label("Seed").fill("42")
    inspector.get_by_label("give the route").uncheck()
    plan(inspector)
    expect(inspector.locator("#draws tbody tr")).to_have_count(3)
    (asked,) = engine.submitted
    controls = asked.controls
    assert (controls.thinking, controls.n, controls.temperature, controls.seed) == ("always", 3, 0.5, 42)
    assert asked.scene.route is None
    assert asked.scene.scene_id == "slow-leader"
    expect(inspector.get_by_role("status")).to_contain_text("3 draws in")


def test_tracks_are_given_to_a_model_that_takes_them(
    page: Page, served: Served, engine: ScriptedEngine
) -> None:
    page.goto(served.url)
    expect(page.get_by_label("give the tracks")).to_be_disabled()
    plain = engine.card_shown
    engine.card_shown = replace(plain, inputs=("route", "tracks"))
    try:
        page.reload()
        page.get_by_label("give the tracks").check()
        engine.submitted.clear()
        plan(page)
        expect(page.locator("#draws tbody tr")).to_have_count(6)
        expect(page.locator("#draws .agreed")).to_have_count(1)
        expect(page.locator("#draws tr.is-chosen .agreed")).to_have_count(1)
        [asked] = engine.submitted
        assert len(asked.scene.tracks or ()) == 3
    finally:
        engine.card_shown = plain


def test_a_second_look_is_shown_with_what_it_changed(inspector: Page) -> None:
    inspector.get_by_label("Thinking", exact=True).select_option("always")
    plan(inspector)
    panel = inspector.locator("#plan-panel")
    expect(panel.get_by_role("heading", name="Plan of draw 0")).to_be_visible()
    expect(panel.locator("blockquote")).to_have_text(REASONING)
    first, revised = panel.locator(".tracks").all()
    expect(first.get_by_role("list", name="longitudinal track").get_by_role("listitem")).to_have_text(
        ["Keep Speed", "Accelerate"]
    )
    expect(revised.get_by_role("list", name="lane track").get_by_role("listitem")).to_have_text(
        ["Keep Lane", "Left Lane Change"]
    )
    expect(first.locator(".changed")).to_have_count(0)
    expect(revised.locator(".changed")).to_have_text(["Decelerate", "Keep Speed", "Left Lane Change"])
    expect(panel.locator("#tokens li")).to_have_text(
        ["plan 40", "branch 1", "thinking 48", "revised plan 52", "trajectory 8"]
    )
    word = revised.get_by_text("Left Lane Change").bounding_box()
    track = revised.get_by_role("list", name="lane track").bounding_box()
    assert word is not None
    assert track is not None
    assert (word["x"] - track["x"]) / track["width"] == pytest.approx(2.4 / 6.4, abs=0.01)


def test_a_direct_draw_has_one_timeline(inspector: Page) -> None:
    inspector.get_by_label("Thinking", exact=True).select_option("never")
    plan(inspector)
    expect(inspector.locator(".tracks")).to_have_count(1)
    expect(inspector.locator("blockquote")).to_have_count(0)
    expect(inspector.locator("#draws .branch")).to_have_text(["direct"] * 6)


def test_the_threshold_slider_plans_again(inspector: Page, engine: ScriptedEngine) -> None:
    plan(inspector)
    expect(inspector.locator("#draws tbody tr")).to_have_count(6)
    slider = inspector.get_by_role("slider", name="Think threshold")
    expect(slider).to_be_disabled()
    expect(inspector.locator("#threshold-value")).to_have_text("sampled")
    inspector.get_by_label("Use a think threshold").check()
    expect(inspector.locator("#threshold-value")).to_have_text("0.50")
    slider.focus()
    inspector.keyboard.press("Home")
    expect(inspector.locator("#draws .branch")).to_have_text(["second look"] * 6)
    inspector.keyboard.press("End")
    expect(inspector.locator("#draws .branch")).to_have_text(["direct"] * 6)
    assert engine.submitted[0].controls.think_threshold is None
    assert engine.submitted[-1].controls.think_threshold == 1.0
    inspector.get_by_label("Thinking", exact=True).select_option("never")
    expect(slider).to_be_disabled()
    expect(inspector.locator("#threshold-value")).to_have_text("unused")


def test_only_thinking_that_the_format_can_be_asked_for_is_offered(
    page: Page, served: Served, engine: ScriptedEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine, "card_shown", replace(CARD, formats=("vla_world",)))
    page.goto(served.url)
    offered = page.locator("#thinking option:enabled")
    expect(offered).to_have_text(["adaptive", "never"])
    expect(page.get_by_label("Use a think threshold")).to_be_disabled()
    expect(page.locator("#threshold-value")).to_have_text("unused")


def test_a_draft_is_shown_beside_what_came_of_the_second_look(
    inspector: Page, engine: ScriptedEngine
) -> None:
    inspector.get_by_label("Thinking", exact=True).select_option("always")
    plan(inspector)
    expect(inspector.locator("#draws tbody tr")).to_have_count(6)
    assert near(pixels(inspector, "#birdseye"), DRAFT_RGB).any()
    expect(inspector.locator("#birdseye")).to_have_attribute("aria-label", re.compile("its draft ended"))
    deadline_ms = engine.submitted[-1].controls.deadline_ms
    assert deadline_ms is not None
    assert deadline_ms < 3000  # of which some is gone
    inspector.get_by_label("Thinking", exact=True).select_option("never")
    inspector.get_by_label("Deadline").fill("")
    plan(inspector)
    expect(inspector.locator("#birdseye")).not_to_have_attribute("aria-label", re.compile("draft"))
    assert engine.submitted[-1].controls.deadline_ms is None
    assert not near(pixels(inspector, "#birdseye"), DRAFT_RGB).any()


def test_poses_at_other_times_are_compared_with_the_expert_at_these(
    inspector: Page, engine: ScriptedEngine
) -> None:
    def errors(draws: int) -> list[float]:
        inspector.get_by_role("spinbutton", name="Draws").fill(str(draws))
        plan(inspector)
        expect(inspector.locator("#draws tbody tr")).to_have_count(draws)
        texts = inspector.locator("#draws td:last-child").all_inner_texts()
        return [float(text.removesuffix(" m")) for text in texts]

    usual = errors(6)
    engine.times_s = tuple(round(0.2 * place, 1) for place in range(1, 33))
    try:
        found = errors(5)
    finally:
        engine.times_s = TEN_HZ_S
    # Every other pose of the same trajectories.
    assert found == pytest.approx(usual[:5], rel=0.1)
    assert found != usual[:5]


def test_draws_are_chosen_by_keyboard(inspector: Page) -> None:
    plan(inspector)
    inspector.get_by_role("radio", name="draw 0").focus()
    before = pixels(inspector, "#birdseye")
    inspector.keyboard.press("ArrowDown")
    expect(inspector.get_by_role("radio", name="draw 1")).to_be_checked()
    expect(inspector.get_by_role("heading", name="Plan of draw 1")).to_be_visible()
    assert (pixels(inspector, "#birdseye") != before).any()


def test_the_birdseye_view_draws_ahead_upwards_and_left_to_the_left(inspector: Page) -> None:
    assert not near(pixels(inspector, "#birdseye"), CHOSEN_RGB).any()
    inspector.get_by_label("Thinking", exact=True).select_option("always")  # a lane change to the left
    inspector.get_by_role("spinbutton", name="Draws").fill("1")
    plan(inspector)
    expect(inspector.locator("#draws tbody tr")).to_have_count(1)
    image = pixels(inspector, "#birdseye")
    rows, columns = np.nonzero(near(image, CHOSEN_RGB))
    middle = image.shape[1] / 2
    lowest, highest = columns[rows > rows.max() - 20], columns[rows < rows.min() + 20]
    assert lowest.mean() == pytest.approx(middle, abs=3), "it starts at the ego, in the middle"
    assert highest.mean() < middle - 3
    assert rows.min() < image.shape[0] / 2
    label = inspector.locator("#birdseye").get_attribute("aria-label") or ""
    assert "1 draws" in label
    assert "to the left" in label


@pytest.mark.parametrize("side", [1, -1], ids=["left", "right"])
def test_the_birdseye_view_shows_a_turn_to_its_end(inspector: Page, tmp_path: Path, side: int) -> None:
    angles = np.linspace(0, np.pi / 2, 64)
    future = np.zeros((64, 4), np.float32)
    future[:, 0], future[:, 1] = 20 * np.sin(angles), side * 40 * (1 - np.cos(angles))
    turn = replace(labelled("turn"), future=future)
    write_scenes(tmp_path / "turn.parquet", [turn])
    inspector.get_by_label("Open a scene file").set_input_files(tmp_path / "turn.parquet")
    expect(inspector.get_by_role("status")).to_contain_text("Scene turn")
    image = pixels(inspector, "#birdseye")
    rows, columns = np.nonzero(near(image, EXPERT_RGB))
    ends_px = columns.min() if side == 1 else image.shape[1] - columns.max()
    assert 15 < ends_px < 60, "its end is in view, and not far from the edge"
    assert rows.max() - rows.min() > 50


def test_clips_can_be_scrubbed(inspector: Page) -> None:
    latest = inspector.locator("#clips img").first.get_attribute("src")
    inspector.get_by_label("Frame").focus()
    inspector.keyboard.press("Home")
    expect(inspector.locator("#frame-time")).to_have_text("\N{MINUS SIGN}1.5 s")
    assert inspector.locator("#clips img").first.get_attribute("src") != latest


def test_clips_can_be_played(inspector: Page) -> None:
    inspector.clock.install()
    play = inspector.locator("#play")
    play.click()
    expect(play).to_have_attribute("aria-pressed", "true")
    for when in ("\N{MINUS SIGN}1.5 s", "\N{MINUS SIGN}1.0 s", "\N{MINUS SIGN}0.5 s", "now"):
        inspector.clock.run_for(500)
        expect(inspector.locator("#frame-time")).to_have_text(when)
    play.click()
    expect(play).to_have_text("Play")
    inspector.clock.run_for(2000)
    expect(inspector.locator("#frame-time")).to_have_text("now")


def test_another_scene_clears_the_draws(inspector: Page, engine: ScriptedEngine) -> None:
    plan(inspector)
    expect(inspector.locator("#draws tbody tr")).to_have_count(6)
    inspector.get_by_label("Scene", exact=True).select_option("second/scene")
    expect(inspector.locator("#draws")).to_be_hidden()
    plan(inspector)
    expect(inspector.locator("#draws")).to_be_visible()
    assert engine.submitted[-1].scene.scene_id == "second/scene"


def test_no_deadline_is_asked_of_an_engine_that_keeps_none(
    page: Page, served: Served, engine: ScriptedEngine
) -> None:
    plain = engine.card_shown
    engine.card_shown = replace(plain, deadlines=False)
    try:
        page.goto(served.url)
        expect(page.get_by_label("Deadline, ms")).to_be_disabled()
        expect(page.locator("#clips img")).to_have_count(2)
        engine.submitted.clear()
        plan(page)
        expect(page.locator("#draws tbody tr")).to_have_count(6)
        assert engine.submitted[0].controls.deadline_ms is None
    finally:
        engine.card_shown = plain


def test_the_threshold_slider_looks_again_where_a_look_is_shown(
    inspector: Page, engine: ScriptedEngine
) -> None:
    proposal = inspector.get_by_label("A plan to look at twice")
    proposal.fill(str(SLOW_DOWN))
    inspector.get_by_role("button", name="Look twice").click()
    expect(inspector.get_by_role("status")).to_contain_text("6 draws in")
    engine.submitted.clear()
    inspector.get_by_label("Use a think threshold").check()
    inspector.get_by_role("slider", name="Think threshold").focus()
    inspector.keyboard.press("End")
    expect(inspector.locator("#draws .branch")).to_have_text(["direct"] * 6)
    assert {str(asked.controls.prefill) for asked in engine.submitted} == {str(SLOW_DOWN)}
    assert proposal.input_value() == str(SLOW_DOWN)


def test_a_problem_is_told_and_goes_away(inspector: Page, engine: ScriptedEngine) -> None:
    engine.failure = EngineError("out of memory")
    plan(inspector)
    alert = inspector.get_by_role("alert")
    expect(alert).to_contain_text("The engine failed")
    expect(alert).to_contain_text("the log has why")
    expect(alert).to_contain_text("request ")
    engine.failure = None
    plan(inspector)
    expect(alert).to_be_hidden()
    expect(inspector.locator("#draws tbody tr")).to_have_count(6)


def test_a_plan_can_be_edited_and_looked_at_twice(inspector: Page, engine: ScriptedEngine) -> None:
    inspector.get_by_label("Thinking", exact=True).select_option("always")
    plan(inspector)
    expect(inspector.locator("#draws tbody tr")).to_have_count(6)
    proposal = inspector.get_by_label("A plan to look at twice")
    edited = proposal.input_value().replace("Accelerate", "Decelerate")
    assert edited != proposal.input_value()
    proposal.fill(edited)
    engine.submitted.clear()
    inspector.get_by_role("button", name="Look twice").click()
    expect(inspector.get_by_role("status")).to_contain_text("6 draws in")
    asked = engine.submitted[0]
    assert str(asked.controls.prefill) == edited
    expect(inspector.locator("blockquote")).to_have_text(REASONING)
    proposal.fill("- nonsense")
    inspector.get_by_role("button", name="Look twice").click()
    expect(inspector.get_by_role("alert")).to_contain_text("plan")
    expect(inspector.get_by_role("button", name="Look twice")).to_be_enabled()


def test_a_plan_can_be_pasted_before_anything_was_planned(inspector: Page, engine: ScriptedEngine) -> None:
    pasted = str(KEEP_ON)
    inspector.get_by_label("A plan to look at twice").fill(pasted)
    inspector.get_by_label("Thinking", exact=True).select_option("always")
    inspector.get_by_role("button", name="Look twice").click()
    expect(inspector.locator("#draws tbody tr")).to_have_count(6)
    expect(inspector.locator("blockquote")).to_have_text(REASONING)
    (asked,) = engine.submitted
    assert str(asked.controls.prefill) == pasted
    assert asked.scene.scene_id == "slow-leader"


def test_without_a_deadline_the_first_plan_is_followed_too(inspector: Page, engine: ScriptedEngine) -> None:
    inspector.get_by_label("Thinking", exact=True).select_option("always")
    inspector.get_by_label("Deadline, ms").fill("")
    plan(inspector)
    expect(inspector.locator("#birdseye")).to_have_attribute("aria-label", re.compile("its draft ended"))
    first, second = engine.submitted
    assert (first.controls.thinking, second.controls.thinking) == ("always", "never")
    assert second.controls.prefill is not None
    assert second.controls.n == 1


def test_what_became_of_the_deadline_is_shown_beside_every_draw(
    inspector: Page, engine: ScriptedEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine, "cut", "shortened")
    inspector.get_by_label("Thinking", exact=True).select_option("always")
    plan(inspector)
    expect(inspector.get_by_role("status")).to_contain_text("deadline met")
    told = inspector.locator("#draws tbody tr td:nth-child(4)")
    expect(told).to_have_text(["met shortened"] * 6)
    inspector.get_by_label("Deadline, ms").fill("")
    plan(inspector)
    expect(told).to_have_text([re.compile("^.$")] * 6)  # a dash


def test_a_deadline_that_was_missed_is_told_beside_every_draw(
    inspector: Page, engine: ScriptedEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine, "cut", "replaced")
    inspector.get_by_label("Thinking", exact=True).select_option("always")
    inspector.get_by_label("Deadline, ms").fill("1")  # which no service keeps
    plan(inspector)
    expect(inspector.get_by_role("status")).to_contain_text("deadline missed")
    told = inspector.locator("#draws tbody tr td:nth-child(4)")
    expect(told).to_have_text(["missed replaced"] * 6)


def test_the_legend_names_every_colour_that_is_drawn(inspector: Page) -> None:
    inspector.get_by_label("Thinking", exact=True).select_option("always")
    plan(inspector)
    expect(inspector.locator("#birdseye")).to_have_attribute("aria-label", re.compile("its draft ended"))
    drawn, named = colours_drawn_and_named(inspector, inspector.locator("#draws tbody tr").nth(1).click)
    assert len(drawn) > 8
    assert drawn - named == {INSIDE_OF_DOTS_RGB}


def test_a_service_that_is_gone_is_told(browser: Browser, tmp_path: Path) -> None:
    page = browser.new_page()
    path = tmp_path / "scenes.parquet"
    write_scenes(path, [labelled("slow-leader")])
    with serve(ScriptedEngine(), Settings(bundled_scenes=path)) as served:
        page.goto(served.url)
        expect(page.locator("#clips img")).to_have_count(2)
    plan(page)
    expect(page.get_by_role("alert")).to_contain_text("The service does not answer")
    page.close()


def test_needs_nothing_from_elsewhere(page: Page, served: Served) -> None:
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    answer = page.goto(served.url)
    expect(page.locator("#clips img")).to_have_count(2)
    assert answer is not None
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert [url for url in asked if not url.startswith((served.url, "data:"))] == []


@pytest.mark.parametrize("width", [820, 1360, 1800])
def test_the_plan_button_is_beside_its_fields(inspector: Page, width: int) -> None:
    inspector.set_viewport_size({"width": width, "height": 800})
    last = inspector.get_by_label("give the tracks").bounding_box()
    button = inspector.get_by_role("button", name="Plan", exact=True).bounding_box()
    assert last is not None
    assert button is not None
    rows = max(last["height"], button["height"])
    assert abs((button["y"] + button["height"] / 2) - (last["y"] + last["height"] / 2)) < rows
    assert 0 < button["x"] - last["x"] < 300
    assert button["y"] + button["height"] < 800


@pytest.mark.parametrize("width", [360, 820, 1800])
def test_fits_any_width(inspector: Page, width: int) -> None:
    inspector.set_viewport_size({"width": width, "height": 800})
    inspector.get_by_label("Thinking", exact=True).select_option("always")
    plan(inspector)
    expect(inspector.locator("blockquote")).to_be_visible()
    page_width = inspector.locator("html").evaluate("page => page.scrollWidth")
    assert page_width <= width


def test_honours_the_dark_scheme(browser: Browser, served: Served) -> None:
    context = browser.new_context(color_scheme="dark", viewport={"width": 1360, "height": 950})
    page = context.new_page()
    page.goto(served.url)
    expect(page.locator("#clips img")).to_have_count(2)
    image = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
    assert near(image[:5], DARK_PAGE_RGB).all()
    assert not near(pixels(page, "#birdseye"), (255, 255, 255)).mean() > 0.05
    context.close()
