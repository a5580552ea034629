"""What the plain decoder asks of a checkpoint, whoever wrote it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from looktwice.model.engines.binding import Binding
from looktwice.model.engines.engine import Controls, PlanRequest
from looktwice.model.engines.engine_requests import PictureCodes
from looktwice.model.engines.least_error import Expected
from looktwice.model.engines.reason_mask import ReasonMask
from looktwice.model.families.family import Family
from looktwice.model.formats.cursor import Allowed, CompiledFormat, FormatVocabulary
from looktwice.model.network.codec import TrajectoryCodec
from looktwice.model.network.model_card import ModelCard
from looktwice.model.network.visual_codes import Frame

Logits = npt.NDArray[np.float64]


class Run(Protocol):
    """A draw in the network: its tokens are fed, one after the other."""

    @property
    def passes(self) -> int:
        """How often the network was run, its prompt apart."""
        ...

    def scores(self, ids: npt.NDArray[np.int64]) -> Logits:
        """float64 [k]: how likely each of these tokens comes next, as logits.

        Where there is one alone its score means nothing, and the network need not be run.
        """
        ...

    def feed(self, token: int) -> None:
        """``token`` was written."""
        ...


@dataclass(frozen=True, eq=False)
class ReadPrompt:
    """A prompt that was read.

    Attributes:
        run: begins a draw behind it.
        binding, reason_mask: what the request's controls leave, where they narrow it.
    """

    run: Callable[[], Run]
    binding: Binding | None = None
    reason_mask: ReasonMask | None = None


class Network(Protocol):
    """A checkpoint in memory."""

    @property
    def card(self) -> ModelCard:
        """What is loaded."""
        ...

    @property
    def families(self) -> Mapping[str, Family]:
        """That it writes, by name."""
        ...

    @property
    def formats(self) -> Mapping[str, CompiledFormat]:
        """Of these, over its tokens."""
        ...

    @property
    def vocabulary(self) -> FormatVocabulary:
        """Its tokens."""
        ...

    @property
    def codec(self) -> TrajectoryCodec | None:
        """Of its trajectory codes; None where it has none."""
        ...

    def check(self, request: PlanRequest) -> None:
        """Raise `RequestError` where a request's controls need what this checkpoint lacks."""
        ...

    def inputs(self, request: PlanRequest) -> tuple[Any, PictureCodes]:
        """What `begin` takes, and the picture that is expected, see `InputBuilder.expected`.

        Raises:
            RequestError: the scene cannot be made into inputs.
            ImageError: a picture is damaged.
        """
        ...

    def expected_error(self, allowed: Allowed, controls: Controls) -> Expected | None:
        """See `LeastError.expected`."""
        ...

    def begin(self, request: PlanRequest, family: Family, inputs: Any) -> ReadPrompt:
        """Read the prompt of a request. Draws of an earlier request must be finished."""
        ...

    def prompt_tokens(self, request: PlanRequest) -> int:
        """See `Engine.prompt_tokens`."""
        ...

    def paint(self, request: PlanRequest, codes: Sequence[int]) -> Frame:
        """See `Engine.paint`."""
        ...

    def load_weights(self, folder: Path) -> None:
        """Take the weights and the card of another folder; see `Engine.load_weights`."""
        ...
