from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from looktwice.model.driving.images import ImageError
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.plan import MetaAction, Plan
from looktwice.model.driving.scene import CAMERAS, Clip, LabelledScene, Scene
from looktwice.model.engines.engine import Draw
from looktwice.model.evaluation.birds_eye import DIRECT_COLOUR, REFLECTED_COLOUR
from looktwice.model.evaluation.pictures import HEIGHT_PX, WIDTH_PX, plan_picture
from looktwice.model.evaluation.timeline import WORD_COLOURS
from tests.model.driving.drives import agent, labelled_scene, picture
from tests.model.evaluation.fakes import draw_of, offset

SCENE = labelled_scene(12.0, agents=(agent(30, 0, 5), agent(20, -4, 1, kind="pedestrian", agent_id=2)))
EXPERT = expert_plan(SCENE)
WRONG = replace(EXPERT, longitudinal=(MetaAction(0, 32, "Reverse"), MetaAction(32, 64, "Wait")))
DIRECT = draw_of(offset(SCENE.future, 1.5), EXPERT)
REFLECTED = draw_of(offset(SCENE.future, -1.5), WRONG, revised=EXPERT, index=1)


def drawn(scene: Scene | LabelledScene, draws: Sequence[Draw], shown: int = 0) -> npt.NDArray[np.uint8]:
    buffer = io.BytesIO()
    plan_picture(scene, draws, buffer, shown=shown)
    pixels = np.asarray(Image.open(buffer).convert("RGB"))
    assert pixels.shape == (HEIGHT_PX, WIDTH_PX, 3)
    return pixels


def count(pixels: npt.NDArray[np.uint8], colour: str) -> int:
    """Pixels of exactly this colour; text and edges are blended and hardly count."""
    return int((pixels == np.round(255 * np.array(to_rgb(colour)))).all(axis=-1).sum())


def test_a_picture_is_written_to_a_path(tmp_path: Path) -> None:
    plan_picture(SCENE, [DIRECT], tmp_path / "plan.png")
    with Image.open(tmp_path / "plan.png") as image:
        assert (image.format, image.size) == ("PNG", (WIDTH_PX, HEIGHT_PX))


def test_the_shown_draws_plan_is_told_with_its_first_version() -> None:
    direct, reflected = drawn(SCENE, [DIRECT, REFLECTED]), drawn(SCENE, [DIRECT, REFLECTED], shown=1)
    for word in ("Reverse", "Wait"):
        assert count(direct, WORD_COLOURS[word]) < 50
        assert count(reflected, WORD_COLOURS[word]) > 5_000
    left = slice(0, WIDTH_PX // 2)  # headline and the mark beside the reflection
    assert count(reflected[:, left], REFLECTED_COLOUR) > 1_000
    assert count(direct[:, left], REFLECTED_COLOUR) == 0


def test_trajectories_wear_their_branchs_colour_and_left_is_left() -> None:
    seen_from_above = drawn(SCENE, [DIRECT, REFLECTED])[100:, WIDTH_PX - 500 :]
    direct = np.nonzero((seen_from_above == np.round(255 * np.array(to_rgb(DIRECT_COLOUR)))).all(axis=-1))
    assert len(direct[0]) > 500
    only_reflected = drawn(SCENE, [REFLECTED])[100:, WIDTH_PX - 500 :]
    reflected = np.nonzero(
        (only_reflected == np.round(255 * np.array(to_rgb(REFLECTED_COLOUR)))).all(axis=-1)
    )
    assert len(reflected[0]) > 500
    assert np.median(direct[1]) < np.median(reflected[1])  # 1.5 m to the left against 1.5 m to the right


def test_a_hole_in_the_road_is_not_road() -> None:
    island = np.array([[10, -4], [30, -4], [30, 4], [10, 4]], np.float32)
    whole = replace(SCENE, agents=(), scene=replace(SCENE.scene, route=None), lane_lines=())
    grass = "#e8ede3"
    without = count(drawn(whole, []), grass)
    for ring in (island, island[::-1].copy()):
        with_hole = replace(whole, drivable=(*whole.drivable, ring))
        assert count(drawn(with_hole, []), grass) > without + 3_000


def test_an_unlabelled_scene_and_a_format_without_plans_are_drawn() -> None:
    pixels = drawn(SCENE.scene, [draw_of(SCENE.future)])
    assert count(pixels, WORD_COLOURS["Straight"]) == 0
    assert count(pixels, DIRECT_COLOUR) > 500


def test_a_scene_is_drawn_without_draws() -> None:
    assert count(drawn(SCENE, []), WORD_COLOURS["Straight"]) > 5_000


def test_groups_that_a_plan_leaves_out_are_drawn_as_such() -> None:
    short = draw_of(SCENE.future, Plan(lateral=EXPERT.lateral))
    straight = WORD_COLOURS["Straight"]  # also that of Keep Lane
    full = count(drawn(SCENE.scene, [DIRECT]), straight)
    assert count(drawn(SCENE.scene, [short]), straight) == pytest.approx(full / 2, rel=0.1)


@pytest.mark.parametrize("count_of_cameras", [1, 3, 8])
def test_any_number_of_cameras_fits(count_of_cameras: int) -> None:
    clips = tuple(Clip(camera, (picture(7),) * 4) for camera in CAMERAS[:count_of_cameras])
    pixels = drawn(replace(SCENE.scene, clips=clips), [DIRECT])[:, : WIDTH_PX - 500]
    columns = np.nonzero((pixels[90:200] != 255).any(axis=(0, 2)))[0]
    assert columns.min() < 30
    assert columns.max() > (400 if count_of_cameras == 1 else 800)
    assert count(pixels, WORD_COLOURS["Straight"]) > 5_000  # the plan still has room


def test_a_dollar_sign_is_no_formula() -> None:
    costly = replace(REFLECTED, thinking="It costs $5 to pass $the {gate and a $\\frac{} more. " * 9)
    drawn(replace(SCENE.scene, scene_id="a$b_{c"), [costly])


def test_bytes_that_are_no_picture_are_an_error() -> None:
    broken = replace(SCENE.scene, clips=(Clip(CAMERAS[0], (b"nothing",) * 4),))
    with pytest.raises(ImageError):
        drawn(broken, [DIRECT])
