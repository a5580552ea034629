from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from looktwice.model.network.blend import blend
from looktwice.model.network.card import CheckpointError
from looktwice.model.network.checkpoint import Loaded, load, save
from looktwice.model.network.vla import with_own_head
from looktwice.service.cli.commands import app

KEPT = (
    *("model.visual.", "resampler.facts.", "resampler.layers.", "resampler.queries"),
    *("resampler.intent.", "track_reader."),
)


@pytest.fixture
def before(resampling_checkpoint: Path) -> Loaded:
    return load(resampling_checkpoint)


@pytest.fixture
def after(resampling_checkpoint: Path) -> Loaded:
    """As `before`, with every weight one more."""
    loaded = load(resampling_checkpoint)
    with torch.no_grad():
        for parameter in loaded.model.parameters():
            parameter.add_(1.0)
    return loaded


def test_the_decoder_goes_back_and_what_sees_and_the_planners_stay(before: Loaded, after: Loaded) -> None:
    old = {name: value.clone() for name, value in before.model.named_parameters()}
    blended = blend(before, after, 0.25)
    for name, value in blended.model.named_parameters():
        moved = 1.0 if name.startswith(KEPT) else 0.25
        if name.startswith(("model.language_model.", *KEPT)):
            torch.testing.assert_close(value, old[name] + moved, atol=1e-5, rtol=0)
    assert blended.card.details["stages"][-1] == {
        "name": "blend",
        "share": 0.25,
        "with": before.card.revision,
    }


def test_what_reads_one_tower_goes_back_too(before: Loaded, after: Loaded) -> None:
    after.model.model.visual.load_state_dict(before.model.model.visual.state_dict())
    old = {name: value.clone() for name, value in before.model.named_parameters()}
    blended = blend(before, after, 0.25)
    for name, value in blended.model.named_parameters():
        if name.startswith(("resampler.", "track_reader.")):
            moved = 1.0 if name.startswith(("resampler.intent.", "track_reader.")) else 0.25
            torch.testing.assert_close(value, old[name] + moved, atol=1e-5, rtol=0)


def test_between_heads_of_their_own_and_embeddings_lies_a_head_of_its_own(
    before: Loaded, after: Loaded, tmp_path: Path
) -> None:
    with_own_head(before.model)
    with torch.no_grad():
        before.model.lm_head.weight.add_(2.0)
    weights = before.model.state_dict()
    embeddings = weights["model.language_model.embed_tokens.weight"].clone()
    head = weights["lm_head.weight"].clone()
    blended = blend(before, after, 0.25)
    save(tmp_path / "blended", blended.model, blended.vocabulary, blended.codec)
    saved = load(tmp_path / "blended").model.state_dict()
    found = saved["model.language_model.embed_tokens.weight"]
    torch.testing.assert_close(found, embeddings + 0.25, atol=1e-5, rtol=0)
    # The head is two more before, and nothing more but one after.
    torch.testing.assert_close(saved["lm_head.weight"], head - 0.25, atol=1e-5, rtol=0)


def test_of_checkpoints_that_differ_in_more_than_weights_there_is_no_blend(
    before: Loaded, untrained_checkpoint: Path
) -> None:
    with pytest.raises(CheckpointError, match="differ in more than their weights"):
        blend(before, load(untrained_checkpoint), 0.5)
    with pytest.raises(ValueError, match="not between 0 and 1"):
        blend(before, replace(before), 1.5)


def test_the_command_writes_a_checkpoint(tmp_path: Path, resampling_checkpoint: Path, after: Loaded) -> None:
    save(tmp_path / "after", after.model, after.vocabulary, after.codec, dtype=torch.bfloat16)
    to = ["--to", str(tmp_path / "between"), "--share", "0.5"]
    told = CliRunner().invoke(app, ["blend", str(resampling_checkpoint), str(tmp_path / "after"), *to])
    assert told.exit_code == 0, told.output
    between = load(tmp_path / "between")
    assert between.card.details["stages"][-1]["share"] == 0.5
    assert between.card.revision not in (
        load(resampling_checkpoint).card.revision,
        load(tmp_path / "after").card.revision,
    )
