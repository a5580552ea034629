"""How near imagined pictures come to what came, beside copies of what was seen last.

Two figures look at the pictures through a network, the checkpoint's own vision tower. They are no figures of
other papers, which take Inception's features, so tables name the extractor.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import torch

from looktwice.model.driving.intervals import Interval
from looktwice.model.driving.next_view import expected_view
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.engines.engine import Draw
from looktwice.model.families.family import PictureRequest
from looktwice.model.network.checkpoint import Loaded
from looktwice.model.network.inputs import moved_pictures
from looktwice.model.network.patches import resize
from looktwice.model.network.visual_codes import Frame, VisualCodes, frame_of, psnr

Array = npt.NDArray[np.float64]

Painter = Callable[[LabelledScene, str], Frame]
"""Makes a picture uint8 [112, 224, 3] of what a camera of a scene will see in half a second."""
_NORMAL_95: Final = 1.96


@dataclass(frozen=True)
class PictureResult:
    """One picture against what came.

    Attributes:
        scene_id, episode_id: the scene's own.
        psnr_db: peak signal-to-noise ratio.
        feature_distance: mean distance between the features of the two at each place.
    """

    scene_id: str
    episode_id: str
    psnr_db: float
    feature_distance: float


@dataclass(frozen=True, eq=False)
class NextFrameResults:
    """Some pictures of as many scenes, against what came.

    Attributes:
        results: in the scenes' order.
        frechet: distance between the features of all pictures and those of all that came; None for one
            picture.
        frechet_interval: 95 %, by leaving out each episode in turn: where episodes are drawn again, pictures
            repeat, and that moves the figure itself. None for one episode.
    """

    results: tuple[PictureResult, ...]
    frechet: float | None
    frechet_interval: Interval | None


class TowerFeatures:
    """A checkpoint's vision tower as an extractor of features."""

    def __init__(self, loaded: Loaded) -> None:
        self._loaded = loaded
        self.name = f"vision tower of {loaded.card.name}"

    @torch.inference_mode()
    def __call__(self, frame: Frame) -> Array:
        """The features [places, hidden] of a picture that does not move."""
        settings, inputs = self._loaded.settings, self._loaded.inputs
        patches = inputs.patchified([resize(frame, settings)] * settings.temporal_patch_size)
        grid = torch.tensor([[1, *settings.grid[1:]]])
        model = self._loaded.model
        tokens = model.vision(torch.from_numpy(patches).to(model.device), grid)
        features: Array = tokens.float().cpu().numpy().astype(np.float64)
        return features


def measure_pictures(
    scenes: Sequence[LabelledScene],
    cameras: Mapping[str, str],
    painters: Mapping[str, Painter],
    features: Callable[[Frame], Array],
) -> dict[str, NextFrameResults]:
    """Hold the pictures of some painters against what came.

    Args:
        scenes: at least one.
        cameras: whose picture it is, by scene id; the scene brings what came.
        painters: by the names of their rows.
        features: [places, width] of a picture.
    """
    results: dict[str, list[PictureResult]] = {name: [] for name in painters}
    seen: dict[str, list[Array]] = {name: [] for name in painters}
    came_seen = []
    for labelled in scenes:
        camera = cameras[labelled.scene.scene_id]
        came = what_came(labelled, camera)
        came_features = features(came)
        came_seen.append(came_features.mean(axis=0))
        for name, painter in painters.items():
            picture = painter(labelled, camera)
            found = features(picture)
            apart = float(np.linalg.norm(found - came_features, axis=1).mean())
            about = labelled.scene.scene_id, labelled.episode_id
            results[name].append(PictureResult(*about, psnr(picture, came), apart))
            seen[name].append(found.mean(axis=0))
    episodes = [labelled.episode_id for labelled in scenes]
    there = np.stack(came_seen)
    return {
        name: NextFrameResults(tuple(results[name]), *frechet_interval(np.stack(of), there, episodes))
        for name, of in seen.items()
    }


def what_came(labelled: LabelledScene, camera: str) -> Frame:
    """What a camera saw half a second later; raises ValueError where the scene does not bring it."""
    for frame in labelled.next_frames:
        if frame.camera == camera:
            return frame_of(frame.image)
    raise ValueError(f"scene {labelled.scene.scene_id} does not bring what {camera} saw half a second later")


def imagined_codes(draw: Draw) -> tuple[int, ...]:
    """The codes of the picture that a draw imagines, which was asked to."""
    foreseen = draw.foreseen
    assert foreseen is not None
    assert foreseen.picture is not None, "a picture was asked for"
    return foreseen.picture.codes


def copied(labelled: LabelledScene, camera: str) -> Frame:
    """The camera's latest picture as it is."""
    return frame_of(labelled.scene.clip(camera).images[-1])


def warped(labelled: LabelledScene, camera: str) -> Frame:
    """The camera's latest picture as seen from where the ego will be if it moves on as it does."""
    return expected_view(copied(labelled, camera), camera, labelled.scene.history)


def through_codes(visual_codes: VisualCodes, shown: Painter) -> Painter:
    """A picture written in codes and painted as imagined ones are, with what was seen last.

    Of what came it is a picture that is imagined without any error; of the last frame, moved, one that is
    imagined as if nothing else changed.
    """

    def paint(labelled: LabelledScene, camera: str) -> Frame:
        moved = moved_pictures(labelled.scene, PictureRequest(camera))
        return visual_codes.decode(visual_codes.encode(shown(labelled, camera)), moved)

    return paint


def frechet_distance(one: Array, other: Array) -> float:
    """Frechet distance between normal distributions that were fitted to features [n, w] and [m, w].

    This is |difference of means|^2 + tr(A + B - 2 (A B)^1/2) of the covariances (Heusel et al., 2017). It
    falls with the number of pictures: compare sets of the same size. Needs two rows of each.
    """
    apart = one.mean(axis=0) - other.mean(axis=0)
    left, right = (np.cov(each, rowvar=False).reshape(each.shape[1], -1) for each in (one, other))
    values, vectors = np.linalg.eigh(left)
    root = (vectors * np.sqrt(values.clip(min=0))) @ vectors.T
    shared = np.sqrt(np.linalg.eigvalsh(root @ right @ root).clip(min=0)).sum()
    return max(0.0, float(apart @ apart + np.trace(left) + np.trace(right) - 2 * shared))


def frechet_interval(
    one: Array, other: Array, episodes: Sequence[str]
) -> tuple[float | None, Interval | None]:
    """The distance of paired features [n, w], and its 95 % interval by leaving out each episode in turn."""
    if len(one) < 2:
        return None, None
    whole = frechet_distance(one, other)
    of = np.array(episodes)
    names = sorted(set(episodes))
    rests = [of != name for name in names]
    if len(names) < 2 or min(rest.sum() for rest in rests) < 2:
        return whole, None
    without = np.array([frechet_distance(one[rest], other[rest]) for rest in rests])
    # The jackknife's variance: how the figure moves with an episode, over all of them.
    error = float(np.sqrt((len(names) - 1) * without.var()))
    return whole, (max(0.0, whole - _NORMAL_95 * error), whole + _NORMAL_95 * error)
