"""Foreign checkpoints for the plain decoder."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from looktwice.model.driving.images import ImageError
from looktwice.model.engines.engine import Controls, PlanRequest, RequestError
from looktwice.model.engines.engine_requests import PictureCodes, painted
from looktwice.model.engines.least_error import Expected, expected_number_error
from looktwice.model.engines.reason_mask import reason_mask_of
from looktwice.model.engines.transformers.plain_network import Logits, ReadPrompt, Run
from looktwice.model.families.family import Family
from looktwice.model.formats.cursor import Allowed
from looktwice.model.network.foreign_checkpoint import ForeignCheckpoint, load_foreign_weights
from looktwice.model.network.visual_codes import Frame


class ForeignNetwork:
    """`Network` over a foreign checkpoint. It reads a prompt once, and forced tokens together.

    Args:
        loaded: the checkpoint.
    """

    codec = None

    def __init__(self, loaded: ForeignCheckpoint) -> None:
        self._loaded = loaded
        # Of a prompt only the last token's logits count; not every network can leave the others out.
        takes = inspect.signature(loaded.model.forward).parameters
        self._last_alone = {"logits_to_keep": 1} if "logits_to_keep" in takes else {}
        self.card, self.vocabulary = loaded.card, loaded.vocabulary
        self.families, self.formats = loaded.families, loaded.formats

    def check(self, request: PlanRequest) -> None:
        """Raise `RequestError` where controls need trajectory codes."""
        if request.controls.bind:
            raise RequestError("bind needs trajectory codes, which this checkpoint does not have")

    def inputs(self, request: PlanRequest) -> tuple[Mapping[str, Tensor], PictureCodes]:
        """See `Network.inputs`; no picture is ever expected."""
        try:
            family = self.families[request.format]
            return self._loaded.inputs.build(request.scene, family, request.attempt), None
        except ImageError:
            raise
        except ValueError as error:
            raise RequestError(str(error)) from error

    def expected_error(self, allowed: Allowed, controls: Controls) -> Expected | None:
        """See `LeastError.expected`; there are no codes."""
        return expected_number_error(allowed, controls)

    def begin(self, request: PlanRequest, family: Family, inputs: Mapping[str, Tensor]) -> ReadPrompt:
        """Read the prompt, whose keys and values each draw copies."""
        model = self._loaded.model
        output = model(**inputs, **self._last_alone, use_cache=True)
        mask = reason_mask_of(request, family, self.vocabulary, None)
        return ReadPrompt(lambda: _ForeignRun(model, output), reason_mask=mask)

    def prompt_tokens(self, request: PlanRequest) -> int:
        """See `Engine.prompt_tokens`."""
        inputs, _ = self.inputs(request)
        return inputs["input_ids"].shape[1]

    def paint(self, request: PlanRequest, codes: Sequence[int]) -> Frame:
        """Raises `RequestError`: there are no codes of pictures."""
        return painted(None, request, codes)

    def load_weights(self, folder: Path) -> None:
        """Take the weights and the card of another folder; see `Engine.load_weights`."""
        self.card = load_foreign_weights(self._loaded, folder)


class _ForeignRun(Run):
    """Runs the network where something is to be decided, over all that was written since."""

    passes = 0

    def __init__(self, model: Any, prompt: Any) -> None:
        self._model, self._cache = model, copy.deepcopy(prompt.past_key_values)
        self._logits, self._written = _last(prompt), list[int]()

    def scores(self, ids: npt.NDArray[np.int64]) -> Logits:
        """See `Run.scores`."""
        if len(ids) == 1:
            return np.zeros(1)
        if self._written:
            written, self._written = torch.tensor([self._written]), []
            output = self._model(input_ids=written, past_key_values=self._cache, use_cache=True)
            self._cache, self._logits = output.past_key_values, _last(output)
            self.passes += 1
        found: Logits = self._logits[ids]
        return found

    def feed(self, token: int) -> None:
        """See `Run.feed`."""
        self._written.append(token)


def _last(output: Any) -> Logits:
    """float64 [vocabulary]: the logits behind the last token."""
    logits: Logits = output.logits[0, -1].double().numpy()
    return logits
