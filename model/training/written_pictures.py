"""Pictures of half a second later as a checkpoint writes them: what its composer has to live with."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable
from itertools import islice
from pathlib import Path
from typing import Final

import torch

from looktwice.model.driving.scene import LabelledScene
from looktwice.model.engines.engine import Controls, PlanRequest
from looktwice.model.engines.torch.in_process import draws_of
from looktwice.model.engines.torch.runner import Runner
from looktwice.model.families.registry import family_named
from looktwice.model.network.allocator import FreedMemory
from looktwice.model.network.checkpoint import Loaded

PictureKey = tuple[str, str]
"""A scene's id and a camera."""
_AT_ONCE: Final = 16


def written_pictures(
    loaded: Loaded, scenes: Iterable[LabelledScene], wanted: Collection[PictureKey], file: Path
) -> dict[PictureKey, tuple[int, ...]]:
    """The 98 codes of wanted pictures, one draw each with the route given; none in ``file`` is drawn again.

    Args:
        loaded: a checkpoint that imagines.
        scenes: that the pictures are of.
        wanted: of which cameras of which scenes.
        file: JSON lines to go on with; made where it is missing.

    Raises:
        ValueError: the checkpoint writes no format that imagines, or ``file`` is of another one.
    """
    format = next((each for each in loaded.card.formats if family_named(each).imagination is not None), None)
    if format is None:
        raise ValueError(f"{loaded.card.name} writes no format that imagines pictures")
    written = _read(file, loaded.card.revision)
    requests = (
        PlanRequest(
            json.dumps([labelled.scene.scene_id, clip.camera]),
            labelled.given(route=True, tracks=False),
            format,
            Controls(n=1, imagine="always", camera=clip.camera),
        )
        for labelled in scenes
        for clip in labelled.scene.clips
        if (labelled.scene.scene_id, clip.camera) in wanted
        and (labelled.scene.scene_id, clip.camera) not in written
    )
    with torch.inference_mode():
        runner, freed = Runner(loaded, _AT_ONCE), FreedMemory()
        while some := list(islice(requests, _AT_ONCE)):
            lines = []
            for name, [draw] in draws_of(runner, some).items():
                assert draw.foreseen is not None
                assert draw.foreseen.picture is not None, "a picture was asked for"
                scene_id, camera = json.loads(name)
                written[scene_id, camera] = draw.foreseen.picture.codes
                row = {"revision": loaded.card.revision, "scene_id": scene_id, "camera": camera}
                lines.append(json.dumps({**row, "codes": draw.foreseen.picture.codes}) + "\n")
            with file.open("a") as kept:
                kept.write("".join(lines))
            freed.give_back()
    return written


def _read(file: Path, revision: str) -> dict[PictureKey, tuple[int, ...]]:
    """What was written before; a last line that a kill cut off is taken away."""
    if not file.exists():
        return {}
    text = file.read_text()
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        file.write_text(whole)
    rows = [json.loads(line) for line in whole.splitlines()]
    if any(row["revision"] != revision for row in rows):
        raise ValueError(f"{file} has pictures that another checkpoint wrote: remove it")
    return {(row["scene_id"], row["camera"]): tuple(row["codes"]) for row in rows}
