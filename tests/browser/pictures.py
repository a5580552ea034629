"""`make pictures`: the README's pictures, of the bundled checkpoint, each with its name and revision inside.

They show the bundled scene and the seed, of a few, whose second look helps most, in draws whose parts agree:
the trajectory scores better by NAVSIM's rules than behind the first plan alone or, where both score the same,
comes nearer to the expert's. None fails. Draws to drive by come first. Without any, the first scene.

Its argument may be the sheet that `looktwice evaluate --preset imagination --checkpoint world-nano --plots`
wrote: then it keeps that one instead, with the name and revision inside.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from playwright.sync_api import expect, sync_playwright

from looktwice.clients.answers import PlannedDraw
from looktwice.clients.planner import PlannerClient, RetryPolicy
from looktwice.clients.wire import Controls
from looktwice.model.bundled import CHECKPOINT, CHECKPOINTS, SCENES
from looktwice.model.driving.facts import LANE_WIDTH_M
from looktwice.model.driving.pdm.judging import SceneJudge
from looktwice.model.driving.pdm.labelled import plans_of
from looktwice.model.driving.route_frame import RouteFrame
from looktwice.model.driving.scene import LabelledScene, Scene
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
DRAWS, SEEDS = 6, range(8)
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


def chosen(planner: PlannerClient, scenes: list[LabelledScene]) -> tuple[int, int, int]:
    """Which scene, which seed, and which of its draws."""
    found: list[tuple[bool, float, float, int, int, int]] = []
    for place, labelled in enumerate(scenes):
        judge = SceneJudge(labelled)
        for seed in SEEDS:
            looked = planner.plan(labelled.scene, Controls(n=DRAWS, seed=seed))
            never: Sequence[PlannedDraw] = ()
            for number, draw in enumerate(looked.draws):
                if draw.thinking is None or not draw.consistent or not lanes_agree(draw, labelled.scene):
                    continue
                never = (
                    never
                    or planner.plan(labelled.scene, Controls(n=DRAWS, seed=seed, thinking="never")).draws
                )
                both = np.stack([never[number].trajectory, draw.trajectory])
                before, after = judge.scores(plans_of(both), "v2.2").partial_score.round(2).tolist()
                farther_m = ade_m(draw, labelled) - ade_m(never[number], labelled)
                if after > max(before, 0) or (after == before > 0 and farther_m < 0):
                    found.append((number != looked.agreed, before - after, farther_m, place, seed, number))
    *_, place, seed, number = min(found, default=(0, 0, 0))
    return place, seed, number


def ade_m(draw: PlannedDraw, labelled: LabelledScene) -> float:
    """How far a draw's trajectory is from the expert's on average."""
    return float(np.linalg.norm(draw.trajectory[:, :2] - labelled.future[:, :2], axis=1).mean())


def lanes_agree(draw: PlannedDraw, scene: Scene) -> bool:
    """Whether the trajectory leaves the route's lane where the plan changes lanes alone, and to that side."""
    assert scene.route is not None
    left_m = RouteFrame(scene.route).places(draw.trajectory[-1:, :2])[0, 1]
    plan = draw.revised_plan or draw.plan
    changes = {action.word for action in plan.lane or () if "Change" in action.word} if plan else set()
    ends = {f"{'Left' if left_m > 0 else 'Right'} Lane Change"} if abs(left_m) > LANE_WIDTH_M / 2 else set()
    return changes == ends


def show_inspector(url: str, scene_id: str, seed: int, draw: int, path: Path) -> None:
    """The page with a draw of a scene's plan chosen."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        page = browser.new_page(viewport={"width": 1360, "height": 950})
        page.set_default_timeout(_PATIENCE_MS)
        expect.set_options(timeout=_PATIENCE_MS)
        page.goto(f"{url}/#scene={scene_id}&thinking=adaptive&n={DRAWS}&temperature=1&seed={seed}&deadline=")
        expect(page.locator("#draws tbody tr")).to_have_count(DRAWS)
        expect(page.get_by_role("status")).to_contain_text("draws in")
        page.locator("#draws input[type=radio]").nth(draw).check()
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
    scenes = list(read_scenes(SCENES))
    with tempfile.TemporaryDirectory() as kept:
        folder = Path(kept)
        with (
            serve(TorchEngine(CHECKPOINT), Settings(bundled_scenes=SCENES)) as served,
            PlannerClient(served.url, RetryPolicy(timeout_s=120)) as planner,
        ):
            place, seed, draw = chosen(planner, scenes)
            scene_id = scenes[place].scene.scene_id
            show_inspector(served.url, scene_id, seed, draw, folder / "inspector.png")
        plan = [
            sys.executable,
            "-m",
            "looktwice.service.cli",
            "plan",
            "--skip",
            str(place),
            "--seed",
            str(seed),
        ]
        subprocess.run([*plan, "--n", str(DRAWS), "--out", kept], check=True, stdout=subprocess.DEVNULL)
        stamped(folder / f"{scene_id}.png", PLAN)
        stamped(folder / "inspector.png", INSPECTOR)
    print(f"{PLAN}\n{INSPECTOR}\nscene {scene_id}, seed {seed}, draw {draw}, {revision()}")


if __name__ == "__main__":
    main()
