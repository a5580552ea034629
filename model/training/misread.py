"""What pictures would be read as, where a scene has none.

Scenes of a planner's own drives are made many times as fast without pictures. A planner that goes by what is
read from pictures can learn from them if it meets the errors that reading makes. So each lead, obstacle,
walker and stretch of road is misread as a like one was in a scene with pictures: the difference between what
was read there and what was true is added to what is true here.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt
import torch

from looktwice.model.driving.facts import FACT_GROUPS, IS_YES_OR_NO
from looktwice.model.driving.trajectory import FloatArray

_ALIKE: Final = 8
"""Of so many nearest ones, one is drawn."""
_ROWS: Final = 1024
_TIE: Final = 1e-3


def misread(
    facts: FloatArray,
    known: FloatArray,
    read: FloatArray,
    random: np.random.Generator,
    device: torch.device = torch.device("cpu"),
) -> FloatArray:
    """Readings float32 [m, times, facts] of scenes without pictures; probabilities of what is or is not so.

    Args:
        facts: [m, facts], what is true in them; NaN where a fact does not apply.
        known: [n, facts], what is true in scenes with pictures.
        read: [n, times, facts], what is read there each time (`looktwice.model.network.fact_reader.likely`).
        random: draws one of the most alike.
        device: where they are looked for.

    Raises:
        ValueError: there are no scenes with pictures to learn the errors from.
    """
    if not len(known):
        raise ValueError("without any scenes with pictures nobody knows how they are read")
    found = np.empty((len(facts), *read.shape[1:]), np.float32)
    first = 0
    for fields in FACT_GROUPS:
        columns = slice(first, first + len(fields))
        first += len(fields)
        mine, theirs = np.nan_to_num(facts[:, columns]), np.nan_to_num(known[:, columns])
        place = _alike(mine, theirs, random, device)
        seen, was_known = read[place, :, columns], np.isfinite(known[place, columns])[:, None]
        found[..., columns] = mine[:, None] + np.where(was_known, seen - theirs[place][:, None], seen)
    return np.where(IS_YES_OR_NO, found.clip(0, 1), found).astype(np.float32)


def _alike(
    mine: FloatArray, theirs: FloatArray, random: np.random.Generator, device: torch.device
) -> npt.NDArray[np.int64]:
    """For each row [m, fields], the place of one of the most alike rows [n, fields]."""
    there, here = torch.from_numpy(theirs).to(device), torch.from_numpy(mine).to(device)
    count, chance = min(_ALIKE, len(theirs)), torch.Generator(device).manual_seed(int(random.integers(2**31)))
    nearest = []
    for start in range(0, len(here), _ROWS):
        apart = torch.cdist(here[start : start + _ROWS], there)
        # Many are the same, above all where nobody is: chance decides between those.
        apart += _TIE * torch.rand(apart.shape, generator=chance, device=device)
        nearest.append(apart.topk(count, largest=False).indices)
    drawn = random.integers(count, size=len(mine))
    return np.asarray(torch.cat(nearest).cpu().numpy()[np.arange(len(mine)), drawn], np.int64)
