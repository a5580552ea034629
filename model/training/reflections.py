"""Reflections of a build, found again among the examples that are trained on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.phrases import read_facts
from looktwice.model.driving.reflection_store import LabelledReflection
from looktwice.model.families.family import Counterfactual
from looktwice.model.training.examples import Examples

_PLAIN: Final = str.maketrans(
    {
        "\u2018": "'",
        "\u2019": "'",
        "\u201c": '"',
        "\u201d": '"',
        "\u2013": "-",
        "\u2014": "-",
        "\u2026": "...",
    }
)
"""Typographic quotes, dashes and dots as ASCII: small tokenizers have no tokens for them."""


def mirrored(reflection: Counterfactual) -> Counterfactual:
    """A reflection with left and right swapped; raises `PhraseError` where it is not in phrases."""
    revised = reflection.revised_plan
    return replace(
        reflection,
        first_plan=reflection.first_plan.mirrored(),
        thinking=str(read_facts(reflection.thinking).mirrored()) if reflection.thinking else "",
        revised_plan=None if revised is None else revised.mirrored(),
    )


class PlacedReflections(NamedTuple):
    """Reflections, the example that each is on, and what its model was told.

    Attributes:
        examples: int64 [m], places.
        told: bool [m, 2], the route; the tracks.
        reflections: m of them.
    """

    examples: npt.NDArray[np.int64]
    told: npt.NDArray[np.bool_]
    reflections: list[Counterfactual]


def plain(text: str) -> str:
    """A text in plain punctuation."""
    return text.translate(_PLAIN)


def places_of(examples: Examples, scene_ids: Iterable[str], what: str) -> npt.NDArray[np.int64]:
    """The places of the examples that scenes are in, int64 [m].

    Args:
        examples: to look in.
        scene_ids: one for each of what is learned.
        what: is on the scenes, in the message.

    Raises:
        ValueError: a scene is missing, or there are several of its id.
    """
    place_of = {str(scene_id): place for place, scene_id in enumerate(examples.scene_id)}
    times = Counter(map(str, examples.scene_id))
    places = []
    for scene_id in scene_ids:
        if scene_id not in place_of:
            raise ValueError(f"there is {what} on scene {scene_id}, which is not among the scenes")
        if times[scene_id] > 1:
            raise ValueError(
                f"there is {what} on scene {scene_id}, and {times[scene_id]} scenes have that id: leave out "
                "the folder whose scenes are of the same seeds, made in another way"
            )
        places.append(place_of[scene_id])
    return np.array(places, np.int64)


def place_reflections(examples: Examples, found: Iterable[LabelledReflection]) -> PlacedReflections:
    """Reflections, in plain punctuation, with the examples of their scenes.

    Raises:
        ValueError: a scene is missing.
    """
    labelled, reflections = list(found), []
    places = places_of(examples, (each.scene_id for each in labelled), "a reflection")
    for each in labelled:
        revised = each.expert_plan if each.reflection else None
        reflections.append(
            Counterfactual(
                each.predicted_plan, plain(each.reflection), revised, each.mend or None, each.judged
            )
        )
    told = np.array([(each.route, each.tracks) for each in labelled], np.bool_).reshape(-1, 2)
    return PlacedReflections(places, told, reflections)
