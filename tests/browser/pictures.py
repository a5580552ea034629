"""`make pictures`: the README's pictures, of the bundled checkpoint, each with its name and revision inside.

They show what `make plan` shows: the first bundled scene, and the draw to drive by. It is a validation scene
where a second look pays: the first plan leaves the road when the simulator follows it, and the revised one
stays on it.

Its argument may be the sheet that `looktwice evaluate --preset imagination --checkpoint world-nano --plots`
wrote: then it keeps that one instead, with the name and revision inside.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

from PIL import Image
from PIL.PngImagePlugin import PngInfo
from playwright.sync_api import expect, sync_playwright

from looktwice.model.bundled import CHECKPOINT, CHECKPOINTS, SCENES
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.engines.torch.engine import TorchEngine
from looktwice.model.network.card import read_card
from looktwice.service.operations.settings import Settings
from tests.browser.conftest import ARGUMENTS, CHROMIUM
from tests.service.serving import serve

FOLDER: Final = Path(__file__).parents[2] / "docs" / "pictures"
PLAN, INSPECTOR, IMAGINED = (FOLDER / f"{name}.png" for name in ("plan", "inspector", "imagined"))
IMAGINING: Final = CHECKPOINTS["world-nano"]
KEY: Final = "looktwice-checkpoint"
DRAWS: Final = 6
_PATIENCE_MS: Final = 180_000
"""For a busy machine; a screenshot of the whole page takes seconds on one that rests."""


def revision(checkpoint: Path = CHECKPOINT) -> str:
    """What stands in the pictures of a bundled checkpoint."""
    card = read_card(checkpoint)
    return f"{card['name']} {card['revision']}"


def stamped(source: Path, target: Path, checkpoint: Path = CHECKPOINT) -> None:
    """Write a PNG again, with the checkpoint that it shows."""
    told = PngInfo()
    told.add_text(KEY, revision(checkpoint))
    with Image.open(source) as picture:
        picture.save(target, pnginfo=told, optimize=True)


def show_inspector(url: str, scene_id: str, path: Path) -> None:
    """The page with a scene's plan, and the draw to drive by chosen."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        page = browser.new_page(viewport={"width": 1360, "height": 950})
        page.set_default_timeout(_PATIENCE_MS)
        expect.set_options(timeout=_PATIENCE_MS)
        page.goto(f"{url}/#scene={scene_id}&thinking=adaptive&n={DRAWS}&temperature=1&seed=0&deadline=")
        expect(page.locator("#draws tbody tr")).to_have_count(DRAWS)
        expect(page.get_by_role("status")).to_contain_text("draws in")
        # The bird's-eye view stays in sight on the way down to the draws.
        page.evaluate("scrollTo(0, 0)")
        page.wait_for_load_state("networkidle")
        shown = revision()
        expect(page.locator("#model")).to_contain_text(re.compile(re.escape(shown)))
        page.screenshot(path=path, full_page=True)
        browser.close()


def main() -> None:
    if sheet := sys.argv[1:]:
        stamped(Path(sheet[0]), IMAGINED, IMAGINING)
        return
    scene_id = next(read_scenes(SCENES)).scene.scene_id
    with tempfile.TemporaryDirectory() as kept:
        folder = Path(kept)
        with serve(TorchEngine(CHECKPOINT), Settings(bundled_scenes=SCENES)) as served:
            show_inspector(served.url, scene_id, folder / "inspector.png")
        plan = [sys.executable, "-m", "looktwice.service.cli", "plan", "--n", str(DRAWS), "--out", kept]
        subprocess.run(plan, check=True, stdout=subprocess.DEVNULL)
        stamped(folder / f"{scene_id}.png", PLAN)
        stamped(folder / "inspector.png", INSPECTOR)


if __name__ == "__main__":
    main()
