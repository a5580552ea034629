"""When to look twice, learned alone: the two rows of the head that a branch is drawn by.

Learned with words and codes, a branch sees each verified plan a few times, and moves everything else while it
learns. Of a network that stays as it is, the best rows are a logistic regression of the states that branches
are drawn from: a convex problem, solved exactly in a second. Two tokens alone may come there, so their rows
mean nothing anywhere else; their embeddings stay, since the head gets weights of its own.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from looktwice.model.driving.reflection_store import read_reflections
from looktwice.model.evaluation.perception import auc
from looktwice.model.families.registry import families_of
from looktwice.model.network.attention import MATMUL_ATTENTION
from looktwice.model.network.card import LOG_FILE
from looktwice.model.network.checkpoint import Loaded, load, save
from looktwice.model.network.vla import with_own_head
from looktwice.model.training.batches import collate
from looktwice.model.training.examples import Examples, load_examples
from looktwice.model.training.learner import ResponseLearner
from looktwice.model.training.recipes import NANO
from looktwice.model.training.reflections import PlacedReflections, place_reflections
from looktwice.model.training.responses import ResponseDataset
from looktwice.model.training.run import RunSettings
from looktwice.model.training.sampler import Item
from looktwice.model.training.trainer import inherit_log
from looktwice.model.training.vision_cache import VisionCache, open_vision

NAME: Final = "branch"
SHARPNESS: Final = 4.0
"""How many times as far apart the options are written as they are likely. A branch is drawn like a word: who
holds three of ten plans for failing would look twice by chance, as often at plans that hold. Written sharper,
what is likelier than not is nearly always drawn, and the rest hardly ever."""
_RIDGE: Final = 100.0
_FOLDS: Final = 8
_BATCH: Final = 16
_STEPS: Final = 50

Array = npt.NDArray[np.float64]
"""Of states [n, hidden], or of rows."""
Looks = npt.NDArray[np.bool_]
"""Whether each of n plans deserves a second look."""


def train_branch(
    scenes: Path, source: Path, target: Path, reflections: Path, settings: RunSettings
) -> Mapping[str, float]:
    """Write ``source`` to ``target`` with a branch that is learned from a build's reflections.

    Args:
        scenes: that the reflections are on, a file or a folder.
        source, target: checkpoint folders.
        reflections: of a build with outcomes: those that are judged.
        settings: ``cache``, ``bf16`` and ``workers`` count.

    Returns:
        Figures of plans that were left out while the rest was learned from: ``auc`` of the think probability,
        ``think_rate``, and of those looks the share that was right (``right``).

    Raises:
        ValueError: the checkpoint has no branch, or the plans that are judged do not go both ways.
        CheckpointError: the source cannot be read.
    """
    loaded = load(source)
    options = _options(loaded)
    examples = load_examples(scenes, settings.cache, loaded.settings.cameras)
    placed = place_reflections(examples, read_reflections(reflections))
    places = [place for place, each in enumerate(placed.reflections) if each.judged]
    looks = np.array([bool(placed.reflections[place].thinking) for place in places], np.bool_)
    if looks.all() or not looks.any():
        raise ValueError(
            f"{reflections}: all plans that are judged go the same way, so nothing tells them apart"
        )
    vision = open_vision(
        loaded, examples, settings.cache, mirrored=True, bf16=settings.bf16, workers=settings.workers
    )
    states = _states(loaded, options, examples, vision, placed, places)
    both = np.tile(looks, 2)
    figures = _held_out(states, both, np.tile(examples.episode[placed.examples[places]], 2))
    _write(loaded, options, _fitted(states, both))
    counts = {"reflections_count": int(looks.sum()), "right_plans_count": int((~looks).sum())}
    stages = [*loaded.card.details.get("stages", []), {"name": NAME} | counts | figures]
    save(
        target,
        loaded.model,
        loaded.vocabulary,
        loaded.codec,
        dtype=torch.bfloat16,
        details={**loaded.card.details, "stages": stages},
        visual_codes=loaded.visual_codes,
    )
    inherit_log(target / LOG_FILE, [source])
    with (target / LOG_FILE).open("a", encoding="utf-8") as log:
        log.write(json.dumps({"stage": f"{len(stages)} {NAME}", "step": 1, **figures}) + "\n")
    return figures


def _options(loaded: Loaded) -> Tensor:
    """int64 [2]: the first token of the direct option, and of the one that reflects.

    Raises:
        ValueError: the checkpoint has no branch.
    """
    settings = loaded.settings
    branches = [
        family.branch
        for family in families_of(settings.formats, settings.reflection).values()
        if family.branch is not None
    ]
    if not branches:
        raise ValueError(f"{loaded.card.name} has no branch: it writes {', '.join(settings.formats)}")
    [branch] = branches
    return torch.tensor([loaded.vocabulary.encode(text)[0] for text in (branch.direct, branch.reflecting)])


@torch.inference_mode()
def _states(
    loaded: Loaded,
    options: Tensor,
    examples: Examples,
    vision: VisionCache,
    placed: PlacedReflections,
    places: Sequence[int],
) -> Array:
    """The states [2 n, hidden] behind the plans of some reflections, as their model was told the scenes.

    The second half of them is of the mirror images.
    """
    recipe = NANO["counterfactual"]
    responses = ResponseDataset(
        examples,
        loaded.codec,
        loaded.inputs,
        loaded.vocabulary,
        recipe.weights,
        pictures=recipe.pictures,
        vision=vision,
        reflections=placed.reflections,
    )
    loaded.model.set_attn_implementation(MATMUL_ATTENTION)
    learner = ResponseLearner(loaded.model, loaded.vocabulary, loaded.codec).eval()
    assert responses.reflecting is not None
    items = [
        Item(
            int(placed.examples[place]),
            responses.reflecting,
            bool(route),
            (place,),
            tracks=bool(tracks),
            mirror=mirror,
        )
        for mirror in (False, True)
        for place in places
        for route, tracks in [placed.told[place]]
    ]
    states = [
        learner.states_before(collate([responses[item] for item in items[start : start + _BATCH]]), options)
        for start in range(0, len(items), _BATCH)
    ]
    found: Array = torch.cat(states).double().numpy()
    return found


def _write(loaded: Loaded, options: Tensor, difference: Array) -> None:
    """Give the head weights of its own, whose branch options differ by ``difference`` [hidden], sharpened."""
    direct, reflecting = options
    with_own_head(loaded.model)
    rows = loaded.model.lm_head.weight
    apart = torch.from_numpy(SHARPNESS * difference).to(rows.dtype)
    with torch.no_grad():
        middle = (rows[direct] + rows[reflecting]) / 2
        rows[direct], rows[reflecting] = middle - apart / 2, middle + apart / 2


def _held_out(states: Array, looks: Looks, episode: npt.NDArray[np.int64]) -> dict[str, float]:
    """Figures over all plans, each judged by rows that were fitted without its episode [n]."""
    score = np.zeros(len(looks))
    episodes = np.random.default_rng(0).permutation(np.unique(episode))
    for left_out in np.array_split(episodes, _FOLDS):
        out = np.isin(episode, left_out)
        if out.any() and not out.all():
            score[out] = states[out] @ _fitted(states[~out], looks[~out])
    thinks, area = score > 0, auc(score, looks)
    assert area is not None, "plans go both ways"
    return {
        "auc": area,
        "think_rate": float(thinks.mean()),
        "right": float(looks[thinks].mean()) if thinks.any() else 0.0,
    }


def _fitted(states: Array, looks: Looks) -> Array:
    """Log odds a state, [hidden]: ridge logistic regression by Newton's method, without a constant.

    States are normed and have a large mean, so one of their directions does for a constant.
    """
    weights, ridge = np.zeros(states.shape[1]), _RIDGE * np.eye(states.shape[1])
    for _ in range(_STEPS):
        likely = 1 / (1 + np.exp(-states @ weights))
        slope = states.T @ (likely - looks) + ridge @ weights
        curve = (states * (likely * (1 - likely))[:, None]).T @ states + ridge
        step = np.linalg.solve(curve, slope)
        weights -= step
        if np.abs(step).max() < 1e-6:
            break
    return weights
