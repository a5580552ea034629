"""When to look twice, learned alone: the two rows of the head that a branch is drawn by.

Learned with words and codes, a branch sees each verified plan a few times, and moves everything else while it
learns. Of a network that stays as it is, the best rows are a logistic regression of the states that branches
are drawn from: a convex problem, solved exactly in a second. Two tokens alone may come there, so their rows
mean nothing anywhere else; their embeddings stay, since the head gets weights of its own.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

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
from looktwice.model.training.own_plans import OwnPlans
from looktwice.model.training.recipes import NANO
from looktwice.model.training.reflections import PlacedReflections, place_reflections
from looktwice.model.training.response_targets import Target
from looktwice.model.training.responses import ResponseDataset
from looktwice.model.training.run_settings import RunSettings
from looktwice.model.training.sampler import Item
from looktwice.model.training.trainer import inherit_log
from looktwice.model.training.vision_cache import VisionCache, open_vision

NAME: Final = "branch"
SHARPNESS: Final = 4.0
"""How many times as far apart the options are written as they are likely. A branch is drawn like a word: who
holds three of ten plans for failing would look twice by chance, as often at plans that hold. Written sharper,
what is likelier than not is nearly always drawn, and the rest hardly ever."""
_RIDGE: Final = 1.0
_FOLDS: Final = 8
_BATCH: Final = 16
_STEPS: Final = 50

Array = npt.NDArray[np.float64]
"""Of states [n, hidden], or of rows."""
Looks = npt.NDArray[np.bool_]
"""Whether each of n plans deserves a second look."""


class _JudgedPlans(NamedTuple):
    """Plans of which is known whether they deserve a second look.

    Attributes:
        states: [n, hidden] that the branch behind each is drawn from.
        looks: [n], whether it deserves one.
        episode: int64 [n], of its scene.
    """

    states: Array
    looks: Looks
    episode: npt.NDArray[np.int64]


def train_branch(
    scenes: Path,
    source: Path,
    target: Path,
    reflections: Path | None,
    settings: RunSettings,
    on_done: Callable[[int, int], None] | None = None,
) -> Mapping[str, float]:
    """Write ``source`` to ``target`` with a branch that is learned alone.

    Args:
        scenes: to learn on, a file or a folder.
        source, target: checkpoint folders.
        reflections: of a build with outcomes, on these scenes: those that are judged count. None for a
            checkpoint with second sketches, whose critic judges a sketch for every scene.
        settings: ``cache``, ``bf16`` and ``workers`` count.
        on_done: told how many of how many batches of prompts are read.

    Returns:
        Figures of plans that were left out while the rest was learned from: ``auc`` of the think probability,
        ``think_rate``, and of those looks the share that was right (``right``).

    Raises:
        ValueError: the checkpoint has no branch, the plans that are judged do not go both ways, or there are
            reflections where a critic judges, or none where none does.
        CheckpointError: the source cannot be read.
    """
    loaded = load(source)
    options = _options(loaded)
    criticised = loaded.settings.second_sketch
    if criticised != (reflections is None):
        raise ValueError(
            f"{loaded.card.name} has a critic that says when to look twice: leave the reflections out"
            if criticised
            else f"{loaded.card.name} has no critic: give a build's reflections, --reflections FILE"
        )
    examples = load_examples(scenes, settings.cache, loaded.settings.cameras)
    placed = None
    if reflections is not None:
        placed = place_reflections(examples, read_reflections(reflections))
        judged = {bool(each.thinking) for each in placed.reflections if each.judged}
        if judged != {False, True}:
            raise ValueError(
                f"{reflections}: all plans that are judged go the same way, so nothing tells them apart"
            )
    vision = open_vision(
        loaded, examples, settings.cache, mirrored=True, bf16=settings.bf16, workers=settings.workers
    )
    plans = _judged_plans(loaded, options, examples, vision, placed, on_done)
    if plans.looks.all() or not plans.looks.any():
        raise ValueError(
            f"{loaded.card.name}'s critic judges all sketches alike, so nothing tells them apart"
        )
    figures, level = _held_out(plans)
    _write(loaded, options, _fitted(plans.states, plans.looks) - level * _constant(plans.states))
    counts = {"looks_count": int(plans.looks.sum()), "plans_count": len(plans.looks)}
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


def _judged_plans(
    loaded: Loaded,
    options: Tensor,
    examples: Examples,
    vision: VisionCache,
    placed: PlacedReflections | None,
    on_done: Callable[[int, int], None] | None,
) -> _JudgedPlans:
    """All plans that are judged, as the model was told their scenes, and their mirror images behind them."""
    recipe = NANO["sketched" if placed is None else "counterfactual"]
    responses = ResponseDataset(
        examples,
        loaded.codec,
        loaded.inputs,
        loaded.vocabulary,
        recipe.weights,
        pictures=recipe.pictures,
        vision=vision,
        reflections=() if placed is None else placed.reflections,
        own_plans=OwnPlans(loaded.model, examples, vision) if placed is None else None,
        sketched=recipe.sketched,
    )
    assert responses.reflecting is not None
    items = _items(examples, placed, responses.reflecting)
    loaded.model.set_attn_implementation(MATMUL_ATTENTION)
    learner = ResponseLearner(loaded.model, loaded.vocabulary, loaded.codec).eval()
    states, looks, episodes = [], list[bool](), list[int]()
    # Prompts with pictures and those without share no batch.
    sorts = [[item for item in items if item.pictures == pictures] for pictures in (True, False)]
    batches = [sort[start : start + _BATCH] for sort in sorts for start in range(0, len(sort), _BATCH)]
    for number, some in enumerate(batches, 1):
        samples = [responses[item] for item in some]
        branches = [
            (examples.episode[item.index], *_branch(response, options.tolist()))
            for item, sample in zip(some, samples, strict=True)
            for response in sample.responses
        ]
        with torch.inference_mode():
            found = learner.states_before(collate(samples), options).double()
        states.append(found[[taught for _, _, taught in branches]])
        looks += [looked for _, looked, taught in branches if taught]
        episodes += [int(episode) for episode, _, taught in branches if taught]
        if on_done is not None:
            on_done(number, len(batches))
    return _JudgedPlans(torch.cat(states).numpy(), np.array(looks, np.bool_), np.array(episodes, np.int64))


def _items(examples: Examples, placed: PlacedReflections | None, task: str) -> list[Item]:
    """The prompts behind which plans are judged; without reflections, all that the model may be given."""
    if placed is not None:
        return [
            Item(
                int(index),
                task,
                bool(route),
                (place,),
                tracks=bool(tracks or not examples.pictured[index]),
                mirror=mirror,
                pictures=bool(examples.pictured[index]),
            )
            for mirror in (False, True)
            for place, (index, (route, tracks)) in enumerate(zip(placed.examples, placed.told, strict=True))
            if placed.reflections[place].judged
        ]
    return [
        Item(
            index,
            task,
            bool(examples.has_route[index]),
            tracks=tracks,
            mirror=mirror,
            pictures=bool(examples.pictured[index]),
        )
        for mirror in (False, True)
        for tracks in (False, True)
        for index in range(len(examples))
        if tracks or examples.pictured[index]
    ]


def _branch(response: Target, options: Sequence[int]) -> tuple[bool, bool]:
    """Whether a response looks twice, and whether it teaches that; ``options`` as `_options` gives them."""
    place = next(place for place, id in enumerate(response.ids) if id in options)
    return response.ids[place] == options[1], response.weights[place] > 0


def _write(loaded: Loaded, options: Tensor, difference: Array) -> None:
    """Give the head weights of its own, whose branch options differ by ``difference`` [hidden], sharpened."""
    direct, reflecting = options
    with_own_head(loaded.model)
    rows = loaded.model.lm_head.weight
    apart = torch.from_numpy(SHARPNESS * difference).to(rows.dtype)
    with torch.no_grad():
        middle = (rows[direct] + rows[reflecting]) / 2
        rows[direct], rows[reflecting] = middle - apart / 2, middle + apart / 2


def _held_out(plans: _JudgedPlans) -> tuple[dict[str, float], float]:
    """Figures over all plans, each judged by rows that were fitted without its episode.

    And the log odds beyond which as many are looked at as deserve it. Few plans are likelier to deserve that
    than not, however well they are told apart: beyond even odds, most looks would be missed.
    """
    states, looks, episode = plans
    score = np.zeros(len(looks))
    episodes = np.random.default_rng(0).permutation(np.unique(episode))
    for left_out in np.array_split(episodes, _FOLDS):
        out = np.isin(episode, left_out)
        if out.any() and not out.all():
            score[out] = states[out] @ _fitted(states[~out], looks[~out])
    level, area = float(np.quantile(score, 1 - looks.mean())), auc(score, looks)
    assert area is not None, "plans go both ways"
    thinks = score > level
    figures = {
        "auc": area,
        "think_rate": float(thinks.mean()),
        "right": float(looks[thinks].mean()) if thinks.any() else 0.0,
    }
    return figures, level


def _constant(states: Array) -> Array:
    """The direction [hidden] along which all states lie at 1; they are normed, and have a large mean."""
    curve = states.T @ states + np.eye(states.shape[1])
    direction: Array = np.linalg.solve(curve, states.sum(axis=0))
    return direction


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
