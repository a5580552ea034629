"""Validation while training: open-loop errors of the network as it stands, in metres."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from model.driving.metrics import displacement_errors
from model.driving.plan import plan_iou
from model.driving.scene import LabelledScene
from model.engines.engine import Controls, DrawFinished, PlanRequest
from model.engines.torch.decoder import Decoder, Failed
from model.engines.torch.runner import Runner
from model.evaluation.open_loop import expert_plan
from model.network.checkpoint import Loaded

_ROWS = 48


def open_loop(
    loaded: Loaded, scenes: Sequence[LabelledScene], formats: Sequence[str], n: int = 6
) -> Mapping[str, float]:
    """minADE over n draws, per format and with or without the route, and the first plan's IOU.

    The network is put into evaluation mode meanwhile.
    """
    futures = {labelled.scene.scene_id: labelled for labelled in scenes}
    network: torch.nn.Module = loaded.model
    was_training = network.training
    network.eval()
    figures: dict[str, float] = {}
    with torch.inference_mode():
        for format in formats:
            for route in (False, True):
                decoder = Decoder(Runner(loaded, _ROWS))
                for labelled in scenes:
                    scene = labelled.scene if route else replace(labelled.scene, route=None)
                    decoder.add(PlanRequest(scene.scene_id, scene, format, Controls(n=n, thinking="never")))
                draws: dict[str, list[DrawFinished]] = {}
                while not decoder.idle:
                    for name, event in decoder.step():
                        if isinstance(event, Failed):
                            raise event.error
                        if isinstance(event, DrawFinished):
                            draws.setdefault(name, []).append(event)
                errors, ious = [], []
                for name, finished in draws.items():
                    trajectories = np.stack([event.draw.trajectory for event in finished])
                    errors.append(displacement_errors(trajectories, futures[name].future).min_ade_m)
                    ious += [
                        plan_iou(event.draw.plan, expert_plan(futures[name]))
                        for event in finished
                        if event.draw.plan is not None
                    ]
                label = f"{format}{'+route' if route else ''}"
                figures[f"min_ade_m/{label}"] = float(np.mean(errors))
                if ious:
                    figures[f"plan_iou/{label}"] = float(np.mean(ious))
    network.train(was_training)
    return figures
