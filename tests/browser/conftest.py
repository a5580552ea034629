from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, BrowserContext, Page, expect, sync_playwright

from looktwice.model.driving.scene_store import write_scenes
from looktwice.service.operations.settings import Settings
from tests.service.scenes import labelled
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served, serve
from tests.sockets import PATIENCE_S

CHROMIUM = "/usr/bin/chromium"
ARGUMENTS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
]


# Not for the session: while it is open, playwright's event loop runs in this thread and asyncio.run refuses.
@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    expect.set_options(timeout=PATIENCE_S * 1000)
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield running
        running.close()


@pytest.fixture
def context(browser: Browser) -> Iterator[BrowserContext]:
    opened = browser.new_context(viewport={"width": 1360, "height": 950})
    yield opened
    opened.close()


@pytest.fixture
def page(context: BrowserContext) -> Iterator[Page]:
    """A page on which an error in a script, or a breach of the security policy, fails the test."""
    opened = context.new_page()
    faults: list[str] = []
    opened.on("pageerror", lambda error: faults.append(str(error)))
    opened.on(
        "console",
        lambda message: (
            faults.append(message.text)
            if message.type == "error" and "status of" not in message.text  # problems are answers, not faults
            else None
        ),
    )
    yield opened
    assert faults == []


@pytest.fixture(scope="module")
def engine() -> ScriptedEngine:
    return ScriptedEngine()


@pytest.fixture(scope="module")
def served(engine: ScriptedEngine, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    path = tmp_path_factory.mktemp("scenes") / "scenes.parquet"
    write_scenes(path, [labelled("slow-leader"), labelled("second/scene")])
    with serve(engine, Settings(bundled_scenes=path)) as running:
        yield running


@pytest.fixture
def inspector(page: Page, served: Served, engine: ScriptedEngine) -> Page:
    engine.submitted.clear()
    page.goto(served.url)
    expect(page.locator("#clips img")).to_have_count(2)
    return page
