"""Validation while training: open-loop errors of the network as it stands, in metres."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import torch

from looktwice.model.driving.scene import LabelledScene
from looktwice.model.engines.engine import Controls, PlanRequest
from looktwice.model.engines.torch.in_process import draws_of
from looktwice.model.engines.torch.runner import Runner
from looktwice.model.evaluation.open_loop import evaluate_draws
from looktwice.model.network.checkpoint import Loaded

_ROWS = 48
_GIVEN: Final = (("", False, False), ("+route", True, False), ("+route+tracks", True, True))
_MEASURES: Final = ("agreed_ade_m", "min_ade_m", "plan_iou_first", "plan_iou_revised", "think_rate")


def open_loop(
    loaded: Loaded, scenes: Sequence[LabelledScene], formats: Sequence[str], n: int = 6
) -> Mapping[str, float]:
    """Errors, IOU of first and last plan and think rate, per format and what is given beside pictures.

    The network is put into evaluation mode meanwhile.
    """
    futures = {labelled.scene.scene_id: labelled for labelled in scenes}
    network: torch.nn.Module = loaded.model
    was_training = network.training
    network.eval()
    figures: dict[str, float] = {}
    with torch.inference_mode():
        for format in formats:
            for suffix, route, tracks in _GIVEN if loaded.settings.with_tracks else _GIVEN[:2]:
                given = [labelled.given(route=route, tracks=tracks) for labelled in scenes]
                requests = [PlanRequest(scene.scene_id, scene, format, Controls(n=n)) for scene in given]
                draws = draws_of(Runner(loaded, _ROWS), requests)
                results = [evaluate_draws(futures[name], finished) for name, finished in draws.items()]
                label = f"{format}{suffix}"
                for measure in _MEASURES:
                    values = [getattr(result, measure) for result in results]
                    if None not in values:
                        figures[f"{measure}/{label}"] = float(np.mean(values))
    network.train(was_training)
    return figures
