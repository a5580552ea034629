"""Steps of training, for tests of what is taught."""

from __future__ import annotations

import torch

from looktwice.model.network.checkpoint import Loaded
from looktwice.model.training.batches import ResponseSample, collate
from looktwice.model.training.learner import ResponseLearner


def two_losses(loaded: Loaded, sample: ResponseSample) -> tuple[float, float]:
    """The loss of a sample, and again after a step that it was learned from."""
    batch = collate([sample])
    learner = ResponseLearner(loaded.model, loaded.vocabulary, loaded.codec)
    optimiser = torch.optim.SGD(learner.parameters(), lr=0.1)
    before = learner(**batch)["loss"]
    before.backward()
    optimiser.step()
    with torch.no_grad():
        after = learner(**batch)["loss"]
    return before.item(), after.item()
