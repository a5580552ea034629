"""Second sketches as a critic might choose them."""

from __future__ import annotations

from collections.abc import Container

import numpy as np

from looktwice.model.network.codec import TrajectoryCodec
from looktwice.model.training.examples import Examples
from looktwice.model.training.own_plans import OwnPlans
from looktwice.model.training.sketched_looks import SecondSketches


def standing_still(
    own_plans: OwnPlans, examples: Examples, codec: TrajectoryCodec, places: Container[int], *, tracks: bool
) -> SecondSketches:
    """To stand still in the examples at some places, likelier to hold by 1; elsewhere the sketch again.

    All facts are those of the first example with somebody ahead.
    """
    found = own_plans.seconds(tracks=tracks)
    assert found is not None
    vectors = found.vectors.copy()
    stands = codec.vectors(examples.history, np.zeros_like(examples.future))
    for mirror in (False, True):
        for route in (False, True):
            for place in range(len(examples)):
                sketch = own_plans.sketch(place, mirror=mirror, route=route, tracks=tracks)
                vectors[int(mirror), int(route), place] = stands[place] if place in places else sketch
    facts = examples.facts[np.flatnonzero(examples.tracks[:, 0, 0])[0]]
    return SecondSketches(vectors, np.broadcast_to(facts, found.facts.shape), np.ones_like(found.gains))
