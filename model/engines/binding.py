"""First trajectory codes that do what a plan says: the control ``bind``. No torch.

The first of the six codes decides by metres, the others by centimetres. What each first code alone carries
out behind a scene's history is labelled once; behind a plan, only those remain that agree with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.agreement import FOLLOWS_IOU
from looktwice.model.driving.labeller import label_plan
from looktwice.model.driving.plan import GROUPS, Plan, parse_plan
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.engines.engine import PlanRequest
from looktwice.model.formats.cursor import Token
from looktwice.model.network.codec import TrajectoryCodec

BoolArray = npt.NDArray[np.bool_]

BOUND_IOU: Final = FOLLOWS_IOU
"""First codes with less IOU with the plan are left out, as far as there are any with more."""
_FIRST_STAGE: Final = 0


class BindingVocabulary(Protocol):
    """What a binding needs to know about a tokenizer."""

    def decode(self, ids: Sequence[int]) -> str:
        """The text of tokens."""
        ...

    def code_ids(self, stage: int) -> range:
        """Ids of the trajectory codes of one stage."""
        ...


def binding_of(request: PlanRequest, codec: TrajectoryCodec, vocabulary: BindingVocabulary) -> Binding | None:
    """The binding of a request that asks for one."""
    return Binding(request.scene.history, codec, vocabulary) if request.controls.bind else None


class Binding:
    """Which first codes a plan leaves, behind one history.

    Takes as long as labelling one trajectory for every first code, so it is made beside the decoding loop.

    Args:
        history: float32 [16, 4] of the scene.
    """

    def __init__(self, history: FloatArray, codec: TrajectoryCodec, vocabulary: BindingVocabulary) -> None:
        self._vocabulary = vocabulary
        self._ids = vocabulary.code_ids(_FIRST_STAGE)
        trajectories = codec.first_trajectories(history)
        self._done = np.stack([label_plan(each, history, None).bins() for each in trajectories])
        self._left: dict[str, BoolArray] = {}

    def leaves(
        self, ids: npt.NDArray[np.int64], written: Sequence[Token], plans: Sequence[str]
    ) -> BoolArray | None:
        """Which of the allowed ``ids`` remain; None where they are no first codes, or no plan is written.

        At least one remains. ``plans`` are the sections that may hold the plan, the one that counts first.
        """
        if len(ids) != len(self._ids) or ids[0] != self._ids.start:
            return None
        text = next((text for name in plans if (text := self._text(name, written))), None)
        if text is None:
            return None
        if text not in self._left:
            # The words that lead to a plan's first bullet belong to the format; a plan may have no tracks.
            plan = parse_plan(text[text.index("- ") :]) if "- " in text else Plan()
            self._left[text] = first_codes(plan, self._done)
        return self._left[text]

    def _text(self, section: str, written: Sequence[Token]) -> str:
        return self._vocabulary.decode([token.id for token in written if token.section == section])


def first_codes(plan: Plan, done: npt.NDArray[np.int8]) -> BoolArray:
    """bool [K]: which of K trajectories agree with a plan, the best ones where none does.

    Args:
        plan: that was written.
        done: int8 [K, 3, 64], the bins of what each carries out (`Plan.bins`); tracks that either side does
            not tell do not count.
    """
    said = plan.bins()
    told = [row for row in range(len(GROUPS)) if said[row, 0] >= 0 and done[0, row, 0] >= 0]
    if not told:
        return np.ones(len(done), np.bool_)
    common = (done[:, told] == said[told]).sum(axis=(1, 2))
    iou = common / (2 * said[told].size - common)
    left: BoolArray = iou >= min(BOUND_IOU, iou.max())
    return left
