"""What ships of VLA-World, as users meet it: it imagines and plans over HTTP and by command."""

from __future__ import annotations

import base64

import numpy as np

from looktwice.clients import wire
from looktwice.clients.planner import PlannerClient, imagine_request
from looktwice.clients.wire_imagine import ImagineControls
from looktwice.model.bundled import CHECKPOINTS, SCENES
from looktwice.model.driving.images import decode_image
from looktwice.model.driving.next_view import expected_view
from looktwice.model.driving.scene import FRONT_WIDE, Scene
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.trajectory import TEN_HZ_S, at_times, constant_velocity
from looktwice.model.engines.torch.engine import TorchEngine
from looktwice.model.families.family import PictureRequest
from looktwice.model.network.inputs import moved_pictures
from looktwice.model.network.visual_codes import Frame, frame_of, load_visual_codes, psnr
from tests.end_to_end.test_bundled import looktwice
from tests.service.serving import Served

BUNDLED = list(read_scenes(SCENES))
CHECKPOINT = CHECKPOINTS["world-nano"]


def imagined(planner: PlannerClient, scene: Scene, motion: wire.Motion | None = None) -> Frame:
    asked = imagine_request(scene, FRONT_WIDE, ImagineControls(temperature=0.5, seed=1))
    [picture] = planner.imagine(asked.model_copy(update={"motion": motion})).pictures
    return decode_image(base64.b64decode(picture.image))


def seen(scene: Scene) -> Frame:
    return frame_of(scene.clip(FRONT_WIDE).images[-1])


def test_it_is_small_and_tells_how_it_was_made(served: Served[TorchEngine]) -> None:
    assert sum(file.stat().st_size for file in CHECKPOINT.rglob("*")) < 40_000_000
    [card] = served.http.get("/v1/models").json()["models"]
    assert (card["name"], card["imagines"], card["paints"]) == ("world-nano", ["vla_world"], True)
    stages = [stage["name"] for stage in card["details"]["stages"]]
    assert stages[-4:] == ["world-sft", "world-sft", "composer", "composer"]


def test_its_pictures_are_of_the_scene(planner: PlannerClient) -> None:
    """Nearer to what the camera would see if nothing else moved than to that of any other scene."""
    scenes = [labelled.scene for labelled in BUNDLED[:6]]
    expected = [expected_view(seen(scene), FRONT_WIDE, scene.history) for scene in scenes]
    own, others = list[float](), list[float]()
    for place, scene in enumerate(scenes):
        picture = imagined(planner, scene)
        for number, frame in enumerate(expected):
            (own if number == place else others).append(psnr(picture, frame))
    assert np.mean(own) > np.mean(others) + 4
    # A picture of its own, too: that of the codes of what is expected comes nearer.
    codes = load_visual_codes(CHECKPOINT)
    unchanged = [
        psnr(codes.decode(codes.encode(frame), moved_pictures(scene, PictureRequest(FRONT_WIDE))), frame)
        for scene, frame in zip(scenes, expected, strict=True)
    ]
    assert np.mean(own) < np.mean(unchanged)


def test_who_stays_sees_what_it_sees_now(planner: PlannerClient) -> None:
    nearer = list[float]()
    for labelled in BUNDLED[:4]:
        scene = labelled.scene
        stays, goes = (imagined(planner, scene, wire.Motion(x_m=x_m)) for x_m in (0.0, 12.0))
        nearer.append(psnr(stays, seen(scene)) - psnr(goes, seen(scene)))
    assert np.mean(nearer) > 1


def test_it_drives_nearer_to_the_expert_than_keeping_on(planner: PlannerClient) -> None:
    own, kept_on = list[float](), list[float]()
    for labelled in BUNDLED:
        answer = planner.plan(labelled.scene, wire.Controls(n=6, seed=1, imagine="never"), format="vla_world")
        draw = answer.draws[answer.agreed]
        assert draw.times_s is not None
        assert draw.sections["perception"]
        expert = at_times(labelled.future, TEN_HZ_S, draw.times_s)[:, :2]
        steady = at_times(constant_velocity(labelled.scene.history), TEN_HZ_S, draw.times_s)[:, :2]
        for apart, points in ((own, draw.trajectory[:, :2]), (kept_on, steady)):
            apart.append(float(np.linalg.norm(points - expert, axis=1).mean()))
    assert np.mean(own) < np.mean(kept_on)


def test_commands_take_it_by_its_name() -> None:
    done = looktwice("plan", "--checkpoint", "world-nano")
    assert done.returncode == 0, done.stderr
    assert "\nPerception: " in done.stdout
    assert "\nAction: " in done.stdout
    assert "None" not in done.stdout
    assert "{" not in done.stdout, "records are told, not dumped"
