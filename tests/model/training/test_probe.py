from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from model.driving.scene import FRONT_TELE, FRONT_WIDE
from model.network.checkpoint import Loaded, load
from model.training.batches import Item, ResponseDataset, collate
from model.training.examples import Examples
from model.training.learner import ResponseLearner
from model.training.probe import SceneProbe
from model.training.targets import PAPER_WEIGHTS
from tests.model.training.scenes import training_scene


@pytest.fixture(scope="module")
def loaded(untrained_checkpoint: Path) -> Loaded:
    return load(untrained_checkpoint)


def test_the_probe_reads_the_prompts_last_token_and_teaches_the_lower_half_alone(loaded: Loaded) -> None:
    examples = Examples.from_scenes((training_scene(k) for k in range(4)), (FRONT_WIDE, FRONT_TELE))
    data = ResponseDataset(
        examples, loaded.codec, loaded.inputs, loaded.vocabulary, PAPER_WEIGHTS, pictures=True
    )
    text: Any = loaded.model.config.text_config
    probe = SceneProbe(text.hidden_size, loaded.codec.books.shape[2])
    with torch.no_grad():
        probe.head.weight.normal_(std=0.1)
    learner = ResponseLearner(loaded.model, loaded.vocabulary.code_ids(0).start, probe=probe)
    batch = collate([data[Item(0, "cf_vla", True)], data[Item(1, "traj_only", False)]])
    parts = learner(**batch)
    plain = ResponseLearner(loaded.model, loaded.vocabulary.code_ids(0).start)(**batch)
    probed = parts["loss"] - plain["loss"]
    assert float(probed.detach()) == pytest.approx(
        float(parts["probe_fact_loss"] + parts["probe_future_loss"]), rel=1e-4
    )
    loaded.model.zero_grad()
    probed.backward()
    layers = loaded.model.model.language_model.layers
    reached = [float(layer.mlp.down_proj.weight.grad.abs().max()) for layer in layers]
    half = len(layers) // 2
    assert min(reached[:half]) > 0
    assert max(reached[half:]) < 1e-6
    # The response is not seen: another first word leaves the probe's loss as it was.
    first = (batch["loss_weights"] > 0).int().argmax(dim=1)
    batch["input_ids"][torch.arange(2), first] = 7
    again = learner(**batch)
    torch.testing.assert_close(again["probe_fact_loss"], parts["probe_fact_loss"])
    assert again["loss"] != parts["loss"]
    loaded.model.zero_grad()


def test_futures_are_given_in_units_of_their_usual_size(loaded: Loaded) -> None:
    examples = Examples.from_scenes((training_scene(k) for k in range(8)), (FRONT_WIDE, FRONT_TELE))
    data = ResponseDataset(
        examples, loaded.codec, loaded.inputs, loaded.vocabulary, PAPER_WEIGHTS, pictures=False
    )
    sizes = [float((data[Item(index, "traj_only", False)].future ** 2).sum()) for index in range(8)]
    assert np.mean(sizes) == pytest.approx(1.0, rel=1e-3)
