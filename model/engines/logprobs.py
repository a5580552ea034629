"""How likely a decision was: the one function that engines report by and that training differentiates."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional

from looktwice.model.engines.engine import Controls
from looktwice.model.formats.cursor import Cursor


def log_probability(logits: Tensor, place: int, temperature: float) -> Tensor:
    """The log-probability of choosing one of the tokens that the format allows; a scalar.

    It belongs to the distribution that words are drawn from, before controls narrow it: ``top_p``,
    ``thinking``, ``bind`` and deadlines leave it as it is. What chooses the token does not matter, either:
    numbers and codes of least expected error are no draws, and are told by the same distribution.

    Args:
        logits: [k] of the allowed tokens, at least two.
        place: of the chosen token among them.
        temperature: of the draw; 0, which draws nothing, counts as 1.
    """
    return functional.log_softmax(logits / (temperature or 1.0), dim=-1)[place]


def reported(controls: Controls, cursor: Cursor, logits: npt.NDArray[np.float64], token: int) -> float | None:
    """What an engine tells of a token that is about to be written; None where nobody asks, or it is forced.

    Args:
        controls: of the request.
        cursor: before the token.
        logits: [k] of the ids that the cursor allows, up to a constant.
        token: that was chosen.
    """
    if not controls.logprobs or len(logits) == 1:
        return None
    place = int(np.searchsorted(cursor.allowed().ids, token))
    return float(log_probability(torch.from_numpy(logits), place, controls.temperature))
