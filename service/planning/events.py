"""What happens to a scene on its way through the service."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import looktwice.clients.wire as wire
from looktwice.model.driving.agreement import Agreement
from looktwice.model.engines.engine import Draw, Event
from looktwice.model.network.model_card import ModelCard

Paint = Callable[[Sequence[int]], npt.NDArray[np.uint8]]


@dataclass(frozen=True)
class Arrival:
    """When and as what a request came.

    Attributes:
        request_id: the caller's, or made here.
        owner: whose key it came with.
        since_s: when its headers were there, on `time.monotonic`.
    """

    request_id: str
    owner: str
    since_s: float


@dataclass(frozen=True)
class Judged:
    """A draw that is finished, and whether its parts agree."""

    draw: Draw
    agreement: Agreement


@dataclass(frozen=True)
class PlannedScene:
    """A scene that was planned for.

    Attributes:
        draws: in order.
        agreements: whether the parts of each draw agree, by index.
        drafts: direct trajectories that were ready before the reflections of their draws, by index.
        card: the model that answered.
        timing: where the time went.
        deadline: what became of it; None where none was set.
        paint: paints the pictures that its draws imagine; takes ms, so not for the event loop.
        prompt_tokens: counts the tokens of its prompt.
    """

    draws: tuple[Draw, ...]
    agreements: dict[int, Agreement]
    drafts: dict[int, Draw]
    card: ModelCard
    timing: wire.Timing
    deadline: wire.Deadline | None
    paint: Paint
    prompt_tokens: Callable[[], int]


@dataclass(frozen=True)
class Begun:
    """The engine has begun with a scene.

    Attributes:
        paint: as of `PlannedScene`.
    """

    paint: Paint


SceneEvent = Event | Begun | Judged | PlannedScene
"""What a scene's events are here: the engine's, and what is made of them."""
