"""What is read from the gathered tokens of a scene: the facts that decide a plan, and a trajectory.

The heads lie beside the checkpoint whose tower and resampler they were trained with. Planning does not
need them: they tell how well the pictures are read.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from model.driving.facts import (
    LANES,
    LEAD_FIELDS,
    OBSTACLE_FIELDS,
    RANKS,
    ROAD_DISTANCES_M,
    WALKER_FIELDS,
    WALKERS,
)
from model.network.codec import TrajectoryCodec
from model.network.intent import IntentTrunk
from model.network.trajectory_head import TrajectoryHead

PERCEPTION_FILE: Final = "perception.safetensors"
_VERSION: Final = 2

QUERY_FIELDS: Final = (
    *((LEAD_FIELDS,) * (len(LANES) * RANKS)),
    *((OBSTACLE_FIELDS,) * len(LANES)),
    *((WALKER_FIELDS,) * WALKERS),
    tuple(f"road_left_{distance}m" for distance in ROAD_DISTANCES_M),
)
"""What each of the first queries tells, in the order of `FACTS`; the others are free."""


class PerceptionError(ValueError):
    """Heads that are missing, damaged or of another checkpoint; the text says which."""


class PerceptionHeads(nn.Module):
    """What is read from the gathered tokens of a scene: facts, and a trajectory.

    Args:
        hidden: width of the tokens.
        queries: how many there are; at least `len(QUERY_FIELDS)`.
        codec: whose space trajectories are told in.
    """

    def __init__(self, hidden: int, queries: int, codec: TrajectoryCodec) -> None:
        super().__init__()
        if queries < len(QUERY_FIELDS):
            raise ValueError(
                f"grounding needs a resampler of at least {len(QUERY_FIELDS)} queries, got {queries}"
            )
        self.facts = nn.ModuleList(nn.Linear(hidden, len(fields)) for fields in QUERY_FIELDS)
        self.trajectory = TrajectoryHead(IntentTrunk.width, codec)

    def read(self, gathered: Tensor) -> Tensor:
        """Facts [b, len(FACTS)], as logits or values, from gathered tokens [b, queries, hidden]."""
        return torch.cat([head(gathered[:, place]) for place, head in enumerate(self.facts)], dim=1).float()

    def save(self, folder: Path) -> None:
        """Write the heads beside a checkpoint."""
        state = {name: value.contiguous() for name, value in self.state_dict().items()}
        save_file(state, folder / PERCEPTION_FILE, metadata={"looktwice": json.dumps({"version": _VERSION})})


def load_heads(folder: Path, hidden: int, queries: int, codec: TrajectoryCodec) -> PerceptionHeads:
    """The heads of a checkpoint's folder, for evaluation; raises `PerceptionError`."""
    path = folder / PERCEPTION_FILE
    if not path.is_file():
        raise PerceptionError(f"{folder} has no {PERCEPTION_FILE}: it was not grounded")
    try:
        with safe_open(path, framework="pt") as file:
            version = json.loads((file.metadata() or {}).get("looktwice", "{}")).get("version")
        if version != _VERSION:
            raise PerceptionError(f"{path} has version {version}; this LookTwice reads {_VERSION}")
        heads = PerceptionHeads(hidden, queries, codec)
        heads.load_state_dict(load_file(path))
    except (SafetensorError, json.JSONDecodeError, RuntimeError) as error:
        raise PerceptionError(f"{path} does not fit this checkpoint: {error}") from error
    return heads.eval()
