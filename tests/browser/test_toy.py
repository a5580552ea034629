"""The page shows a family that nobody but its folder knows."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Page, expect

from looktwice.model.driving.scene_store import write_scenes
from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.model.network.vla_settings import VlaSettings
from looktwice.service.operations.settings import Settings
from tests.checkpoints import write_untrained
from tests.service.scenes import labelled
from tests.service.serving import Served, serve


@pytest.fixture(scope="module")
def served(toy_family: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served[TorchEngine]]:
    folder = tmp_path_factory.mktemp("toy")
    settings = VlaSettings(name="toy", formats=("toy",))
    checkpoint = write_untrained(folder / "checkpoint", narrow=True, settings=settings)
    write_scenes(folder / "scenes.parquet", [labelled("slow-leader")])
    engine = TorchEngine(checkpoint, TorchSettings(rows=4, products=None))
    with serve(engine, Settings(bundled_scenes=folder / "scenes.parquet")) as running:
        yield running


def test_all_that_a_draw_says_is_shown(page: Page, served: Served[TorchEngine]) -> None:
    page.goto(served.url)
    expect(page.locator("#clips img")).to_have_count(2)
    page.get_by_label("Thinking", exact=True).select_option("always")
    page.get_by_role("spinbutton", name="Draws").fill("2")
    with page.expect_response("**/v1/plan") as answered:
        page.get_by_role("button", name="Plan", exact=True).click()
    answer = answered.value.json()
    draw = answer["draws"][answer["agreed"]]
    [gap], [turns] = (section["values"] for section in draw["sections"])
    panel = page.locator("#timeline")
    expect(panel.locator('h3:text-is("gap") + p')).to_have_text(f"{gap:g}")
    expect(panel.locator('h3:text-is("turns") + p')).to_have_text(" ".join(map(str, turns)))
    expect(panel.locator('h3:text-is("Second look") + blockquote')).to_be_visible()
    expect(panel.locator("#tokens")).to_contain_text("speeds")
    # It has no plan, and nothing pretends that one is missing.
    expect(panel.get_by_text("plan", exact=False)).to_have_count(0)
    expect(page.locator("#draws tbody tr")).to_have_count(2)
