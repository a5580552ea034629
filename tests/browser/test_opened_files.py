"""Scene files that are opened on the inspector page."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import FilePayload, Page, expect

from looktwice.model.driving.scene_store import write_scenes
from tests.browser.pages import plan
from tests.service.scenes import labelled
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served, body


def test_opens_a_parquet_scene_file(inspector: Page, engine: ScriptedEngine, tmp_path: Path) -> None:
    path = tmp_path / "mine.parquet"
    write_scenes(path, [labelled("from-a-file")])
    inspector.get_by_label("Open a scene file").set_input_files(path)
    expect(inspector.get_by_role("status")).to_contain_text("Scene from-a-file")
    plan(inspector)
    expect(inspector.locator("#draws tbody tr")).to_have_count(6)
    assert engine.submitted[-1].scene.scene_id == "from-a-file"


def test_opens_a_json_scene_that_is_dropped(inspector: Page, engine: ScriptedEngine) -> None:
    dropped(inspector, body()["scene"] | {"scene_id": "dropped"})
    expect(inspector.get_by_role("status")).to_contain_text("Scene dropped")
    plan(inspector)
    expect(inspector.locator("#draws tbody tr")).to_have_count(6)
    expect(inspector.locator("#draws tbody tr").first).to_contain_text(
        "\N{EN DASH}"
    )  # no expert to compare with
    assert engine.submitted[-1].scene.scene_id == "dropped"


def dropped(page: Page, document: dict[str, Any]) -> None:
    page.locator("body").evaluate(
        """(target, text) => {
            const dataTransfer = new DataTransfer();
            dataTransfer.items.add(new File([text], "scene.json", {type: "application/json"}));
            target.dispatchEvent(new DragEvent("drop", {dataTransfer, bubbles: true, cancelable: true}));
        }""",
        json.dumps(document),
    )


def test_tracks_of_a_json_scene_are_given(page: Page, served: Served, engine: ScriptedEngine) -> None:
    shown = served.http.get("/v1/scenes/slow-leader").json()
    plain = engine.card_shown
    engine.card_shown = replace(plain, inputs=("route", "tracks"))
    try:
        page.goto(served.url)
        page.get_by_label("give the tracks").check()
        request = {"scene": shown["scene"] | {"scene_id": "asked", "tracks": shown["tracks"][:2]}}
        for document, scene_id, count in ((shown, "slow-leader", 3), (request, "asked", 2)):
            dropped(page, document)
            expect(page.locator("#scene option:checked")).to_contain_text("scene.json")
            expect(page.get_by_role("status")).to_contain_text(f"Scene {scene_id}")
            engine.submitted.clear()
            with page.expect_response("**/v1/plan"):  # the table has rows of the plan before
                plan(page)
            assert len(engine.submitted[0].scene.tracks or ()) == count
        dropped(page, shown["scene"] | {"scene_id": "bare"})
        expect(page.get_by_role("status")).to_contain_text("Scene bare")
        expect(page.get_by_label("give the tracks")).to_be_disabled()
    finally:
        engine.card_shown = plain


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("broken.parquet", b"PAR1 and nothing", "truncated"),
        ("broken.json", b"{", "broken.json is not JSON"),
        ("other.json", b'{"hello": 1}', "other.json holds no scene"),
    ],
)
def test_a_bad_file_is_told_and_the_scene_stays(
    inspector: Page, name: str, content: bytes, said: str
) -> None:
    chosen = FilePayload(name=name, mimeType="application/octet-stream", buffer=content)
    inspector.get_by_label("Open a scene file").set_input_files(chosen)
    expect(inspector.get_by_role("alert")).to_contain_text(said)
    expect(inspector.get_by_role("status")).to_have_text(f"{name} was not opened.")
    expect(inspector.get_by_label("Scene", exact=True)).to_have_value("slow-leader")
