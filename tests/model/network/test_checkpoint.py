from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from transformers import (
    AutoModelForImageTextToText,
    Qwen2_5_VLForConditionalGeneration,
)

from looktwice.model.bundled import CHECKPOINT
from looktwice.model.families.family import Situation
from looktwice.model.families.picture_codes import levels_of
from looktwice.model.network.card import CARD_FILE, CheckpointError, read_card, weights_revision
from looktwice.model.network.checkpoint import Loaded, create_nano, expand_stock, load, save, with_formats
from looktwice.model.network.codec import CODEC_FILE, TrajectoryCodec
from looktwice.model.network.inputs import InputBuilder
from looktwice.model.network.repository import write_repository
from looktwice.model.network.small_planner import SmallPlanner, small_revision
from looktwice.model.network.visual_codes import WEIGHTS_FILE as VISUAL_CODES_FILE
from looktwice.model.network.visual_codes import VisualCodes
from looktwice.model.network.vla_settings import VlaSettings
from looktwice.model.network.vocabulary import Vocabulary, build_nano_tokenizer
from tests.model.network.conftest import made_up_scene
from tests.model.network.stock import write_stock


@pytest.fixture(scope="module")
def nano(nano_folder: Path) -> Loaded:
    return load(nano_folder)


@torch.no_grad()
def logits_of(loaded: Loaded) -> torch.Tensor:
    inputs = loaded.inputs.build(made_up_scene(4), "cf_vla")
    prompt = loaded.model.encode_prompt_embeddings(inputs)
    model: Any = loaded.model
    logits: torch.Tensor = model(
        inputs_embeds=prompt.embeddings[None], position_ids=prompt.position_ids[:, None]
    ).logits
    return logits.float()


def test_card_says_what_it_is(nano: Loaded, nano_folder: Path) -> None:
    card = nano.card
    assert card.name == "looktwice-nano"
    assert card.engine == "torch"
    assert card.formats == ("cf_vla", "traj_only")
    assert card.image_size == (224, 112)
    assert 6e6 < card.parameters < 10e6
    assert card.revision == weights_revision(nano_folder)
    assert not nano.model.training


def test_seed_decides_the_weights(
    nano_folder: Path, small_codec: TrajectoryCodec, vocabulary: Vocabulary, tmp_path: Path
) -> None:
    create_nano(tmp_path / "same", small_codec, vocabulary, seed=3)
    create_nano(tmp_path / "other", small_codec, vocabulary, seed=4)
    assert weights_revision(tmp_path / "same") == weights_revision(nano_folder)
    assert weights_revision(tmp_path / "other") != weights_revision(nano_folder)


def test_more_formats_leave_what_it_writes_as_it_is(nano_folder: Path, tmp_path: Path) -> None:
    before, wider = load(nano_folder), with_formats(load(nano_folder), ["elf_vla", "cf_vla"])
    assert wider.card.formats == wider.settings.formats == ("cf_vla", "traj_only", "elf_vla")
    save(tmp_path, wider.model, wider.vocabulary, wider.codec)
    again = load(tmp_path)
    assert again.settings == wider.settings
    written = slice(len(before.vocabulary))
    torch.testing.assert_close(logits_of(again)[..., written], logits_of(before)[..., written])


def test_numbers_as_tokens_begin_near_their_neighbours(nano_folder: Path) -> None:
    loaded = load(nano_folder)
    phrased = replace(
        loaded, inputs=InputBuilder(loaded.vocabulary, replace(loaded.settings, reflection="phrases"))
    )
    wider = with_formats(phrased, ["elf_vla"])
    assert set(wider.vocabulary.alphabets) == {"trajectory", "x_m", "y_m", "heading_rad"}
    [ids] = wider.vocabulary.alphabets["x_m"]
    embeddings: Any = wider.model.get_input_embeddings()
    rows = torch.nn.functional.normalize(embeddings.weight[ids.start : ids.stop].detach(), dim=1)
    alike = (rows @ rows.T).numpy()
    assert alike.diagonal(1).mean() > 0.9 > 0.7 > alike.diagonal(200).mean()
    assert alike.diagonal(1).max() < 0.99


def test_codes_of_pictures_begin_near_those_that_paint_alike(nano_folder: Path, tmp_path: Path) -> None:
    before, wider = load(nano_folder), with_formats(load(nano_folder), ["vla_world"])
    assert set(wider.vocabulary.alphabets) == {"trajectory", "visual"}
    [ids] = wider.vocabulary.alphabets["visual"]
    assert (ids.start, len(ids)) == (len(before.vocabulary), 1000)
    assert wider.vocabulary.decode([ids[7]]) == "<|visual_0007|>"
    embeddings: Any = wider.model.get_input_embeddings()
    rows = torch.nn.functional.normalize(embeddings.weight[ids.start : ids.stop].detach(), dim=1)
    alike = (rows @ rows.T).numpy()
    levels = levels_of(np.arange(1000))
    apart = np.abs(levels[:, None] - levels[None]).sum(-1)
    assert alike[apart == 1].mean() > 0.7 > 0.3 > alike[apart >= 8].mean()
    assert alike[apart == 1].max() < 0.99
    save(tmp_path, wider.model, wider.vocabulary, wider.codec)
    again = load(tmp_path)
    written = slice(len(before.vocabulary))
    torch.testing.assert_close(logits_of(again)[..., written], logits_of(before)[..., written])


def test_saved_in_half_and_loaded(nano: Loaded, tmp_path: Path) -> None:
    save(tmp_path, nano.model, nano.vocabulary, nano.codec, dtype=torch.bfloat16, details={"recipe": "none"})
    assert next(iter(nano.model.parameters())).dtype == torch.float32
    again = load(tmp_path)
    assert again.card.details == {"recipe": "none"}
    assert (tmp_path / "model.safetensors").stat().st_size < 40e6
    modes = {file.name: file.stat().st_mode for file in tmp_path.iterdir()}
    assert set(modes.values()) == {modes["config.json"]}, "who may read one file may read all of them"
    # Stored and read back once more, nothing changes any more.
    save(tmp_path / "again", again.model, again.vocabulary, again.codec, dtype=torch.bfloat16)
    assert weights_revision(tmp_path) == weights_revision(tmp_path / "again")
    torch.testing.assert_close(logits_of(load(tmp_path / "again")), logits_of(again))
    torch.testing.assert_close(logits_of(again), logits_of(nano), atol=0.05, rtol=0.05)


def test_books_of_sketches_are_stored_as_they_are(tmp_path: Path) -> None:
    """A sketch is told by the nearest code: in rounded books, one in nine has another nearest one."""
    loaded = load(CHECKPOINT)
    books = loaded.model.sketch_books
    assert books is not None
    books.fill(loaded.codec)
    save(tmp_path, loaded.model, loaded.vocabulary, loaded.codec, dtype=torch.bfloat16)
    again = load(tmp_path).model.sketch_books
    assert again is not None
    for name, exact in books.named_parameters():
        assert torch.equal(dict(again.named_parameters())[name], exact)


def test_near_codes_begin_near(nano: Loaded) -> None:
    model: Any = nano.model
    rows = model.get_input_embeddings().weight.detach()
    words = torch.from_numpy(nano.codec.code_vectors())
    for stage in range(2):
        ids = nano.vocabulary.code_ids(stage)
        embedded = torch.pdist(rows[ids.start : ids.stop])
        assert np.corrcoef(embedded, torch.pdist(words[stage]))[0, 1] > 0.8
    ordinary = rows[: nano.vocabulary.code_ids(0).start].std()
    assert 0.5 < float(rows[nano.vocabulary.code_ids(0).start :][:96].std() / ordinary) < 2


@torch.no_grad()
def test_transformers_loads_the_backbone(nano: Loaded, nano_folder: Path) -> None:
    stock: Any = AutoModelForImageTextToText.from_pretrained(nano_folder)
    assert type(stock) is Qwen2_5_VLForConditionalGeneration
    ids = torch.from_numpy(nano.inputs.prompt("cf_vla", Situation(made_up_scene(1).history)).ids[:10])[None]
    ours: Any = nano.model
    torch.testing.assert_close(stock(input_ids=ids).logits, ours(input_ids=ids).logits)


@pytest.mark.parametrize(
    ("missing", "message"),
    [
        (CARD_FILE, "not a LookTwice checkpoint"),
        ("config.json", "no config.json"),
        ("tokenizer.json", "tokenizer"),
        ("model.safetensors", "no model.safetensors"),
        (CODEC_FILE, CODEC_FILE),
    ],
)
def test_missing_parts_are_named(nano_folder: Path, tmp_path: Path, missing: str, message: str) -> None:
    folder = tmp_path / "broken"
    shutil.copytree(nano_folder, folder)
    (folder / missing).unlink()
    with pytest.raises(CheckpointError, match=message):
        load(folder)


@pytest.mark.parametrize(
    "name", [CARD_FILE, "config.json", "model.safetensors", CODEC_FILE, "tokenizer.json"]
)
def test_damaged_parts_are_named(nano_folder: Path, tmp_path: Path, name: str) -> None:
    folder = tmp_path / "broken"
    shutil.copytree(nano_folder, folder)
    (folder / name).write_bytes((folder / name).read_bytes()[:100])
    with pytest.raises(CheckpointError, match="broken"):
        load(folder)


def test_other_versions_and_kinds_are_refused(nano_folder: Path, tmp_path: Path) -> None:
    folder = tmp_path / "other"
    shutil.copytree(nano_folder, folder)
    card = json.loads((folder / CARD_FILE).read_text())
    (folder / CARD_FILE).write_text(json.dumps(card | {"version": 99}))
    with pytest.raises(CheckpointError, match="version 99"):
        load(folder)
    (folder / CARD_FILE).write_text(json.dumps({"version": 1}))
    with pytest.raises(CheckpointError, match="details, name, parameters, revision"):
        load(folder)
    (folder / CARD_FILE).write_text(json.dumps(card))
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({k: v for k, v in config.items() if k != "looktwice"}))
    with pytest.raises(CheckpointError, match="expand a stock checkpoint"):
        load(folder)
    (folder / "config.json").write_text(json.dumps(config | {"model_type": "llama"}))
    with pytest.raises(CheckpointError, match="'llama'"):
        load(folder)


def test_codec_and_vocabulary_must_agree(small_codec: TrajectoryCodec, tmp_path: Path) -> None:
    other = Vocabulary(build_nano_tokenizer(["a b"], 8, size=260))
    with pytest.raises(CheckpointError, match="16 codes per stage, the vocabulary 8"):
        create_nano(tmp_path, small_codec, other)


@pytest.mark.parametrize("spare_rows", [0, 500])
@torch.no_grad()
def test_a_stock_checkpoint_is_expanded(
    small_codec: TrajectoryCodec, tmp_path: Path, spare_rows: int
) -> None:
    stock = write_stock(tmp_path / "stock", spare_rows)
    settings = VlaSettings(name="tiny", image_width=112, image_height=56, formats=("cf_vla",))
    expand_stock(tmp_path / "stock", tmp_path / "ours", small_codec, settings, dtype=torch.float32)
    loaded = load(tmp_path / "ours", dtype=torch.float64)
    assert loaded.card.name == "tiny"
    assert loaded.settings.tokens_per_second == 2
    assert loaded.settings.codec_size == small_codec.size
    text = "slow down<|im_end|>\n"
    assert loaded.vocabulary.encode(text) == tuple(stock.encode(text))
    before: Any = Qwen2_5_VLForConditionalGeneration.from_pretrained(tmp_path / "stock", dtype=torch.float64)
    ids = torch.tensor([stock.encode(text)])
    ours: Any = loaded.model
    size = len(stock)
    assert ours.config.text_config.vocab_size == ours.lm_head.weight.shape[0] >= len(loaded.vocabulary)
    torch.testing.assert_close(
        ours(input_ids=ids).logits[..., :size], before(input_ids=ids).logits[..., :size]
    )
    logits = logits_of(loaded)
    assert torch.isfinite(logits).all()


def test_expanding_needs_a_qwen(small_codec: TrajectoryCodec, tmp_path: Path) -> None:
    settings = VlaSettings()
    with pytest.raises(CheckpointError, match=r"no config\.json"):
        expand_stock(tmp_path / "none", tmp_path / "ours", small_codec, settings)
    with pytest.raises(CheckpointError, match="another folder"):
        expand_stock(tmp_path, tmp_path, small_codec, settings)


def test_a_checkpoint_is_told_by_its_weights_whatever_its_card_says(
    nano_folder: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "other"
    shutil.copytree(nano_folder, folder)
    weights = load_file(folder / "model.safetensors")
    others = {name: torch.zeros_like(tensor) for name, tensor in weights.items()}
    save_file(others, folder / "model.safetensors")
    assert load(folder).card.revision == weights_revision(folder) != load(nano_folder).card.revision


def test_a_revision_covers_the_codec_and_the_codes_of_pictures(
    nano: Loaded, nano_folder: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "other"
    shutil.copytree(nano_folder, folder)
    codec = nano.codec
    replace(codec, mean=codec.mean + np.float32(0.1)).save(folder)
    revisions = [nano.card.revision, load(folder).card.revision]
    for seed in range(2):
        torch.manual_seed(seed)
        VisualCodes().save(folder, {})
        revisions.append(load(folder).card.revision)
    assert len(set(revisions)) == 4
    write_repository(folder)
    assert read_card(folder)["revision"] == revisions[-1], "cards are renewed"
    codec.save(folder)
    (folder / VISUAL_CODES_FILE).unlink()
    assert weights_revision(folder) == revisions[0]
    (folder / CODEC_FILE).unlink()
    with pytest.raises(CheckpointError, match=CODEC_FILE):
        weights_revision(folder)


def test_a_small_planners_revision_covers_its_codec(small_codec: TrajectoryCodec, tmp_path: Path) -> None:
    SmallPlanner("blind", small_codec).save(tmp_path, {})
    before = small_revision(tmp_path)
    replace(small_codec, mean=small_codec.mean + np.float32(0.1)).save(tmp_path)
    assert small_revision(tmp_path) != before
