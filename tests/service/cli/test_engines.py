from __future__ import annotations

from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.service.cli.commands import app
from looktwice.service.cli.engines import make_engine

RUNNER = CliRunner()


def test_the_torch_engine_is_made_unless_said_otherwise(untrained_checkpoint: Path) -> None:
    assert make_engine(untrained_checkpoint, 4).card.engine == "torch"
    assert make_engine(untrained_checkpoint, 4, name="vllm").card.engine == "vllm"


def test_a_gpu_works_in_bfloat16_throughout() -> None:
    settings = TorchSettings.on("cuda", 8)
    assert (settings.rows, settings.dtype, settings.products) == (8, torch.bfloat16, None)
    assert TorchSettings.on("cpu", 8) == TorchSettings(rows=8)


@pytest.mark.parametrize(("arguments", "message"), [("{", "no JSON"), ("[1]", "a JSON object")])
def test_vllm_arguments_must_be_an_object(untrained_checkpoint: Path, arguments: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_engine(untrained_checkpoint, 4, name="vllm", vllm_arguments=arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--engines", "torch,hf"], "unknown engine hf"),
        (["--at-once", "1,0"], "'0' is no positive number"),
        (["--draws", "65"], "n must be a whole number in 1..64"),
        (["--thinking", "sometimes"], "thinking must be"),
        (
            ["--format", "traj_only", "--thinking", "always"],
            "traj_only cannot be asked for always; ask for adaptive or never",
        ),
        (["--camera", "front_wide_120"], "cf_vla imagine no pictures"),
        (["--format", "prose"], "no model family 'prose'"),
        (["--preset", "cf-vla-3b"], "say --random-weights"),
        (["--preset", "gpt"], "unknown preset 'gpt'"),
    ],
)
def test_the_bench_refuses_what_it_cannot_measure(arguments: list[str], message: str) -> None:
    result = RUNNER.invoke(app, ["bench", "engine", *arguments])
    assert result.exit_code == 2
    assert message in result.stderr


def test_the_operator_bounds_what_is_kept_of_pictures(untrained_checkpoint: Path) -> None:
    engine = make_engine(untrained_checkpoint, 4, cache_mb=1)
    assert isinstance(engine, TorchEngine)
    assert engine._settings.clip_bytes == 1 << 20


@pytest.mark.parametrize(
    ("told", "reproducible"), [([], True), (["--fast"], False), (["--reproducible"], True)]
)
def test_who_serves_chooses_between_equal_bytes_and_speed(
    told: list[str], reproducible: bool, untrained_checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []

    def note(engine: TorchEngine, *args: object, **named: object) -> None:
        made.append(engine._settings.reproducible)
        raise ValueError("that is enough")

    monkeypatch.setattr("looktwice.service.app.create_app", note)
    # They are of the whole process, which is the tests' own here.
    monkeypatch.setattr("looktwice.model.network.allocator.return_large_buffers", lambda: None)
    monkeypatch.setattr("sys.setswitchinterval", lambda _: None)
    result = RUNNER.invoke(app, ["serve", "--checkpoint", str(untrained_checkpoint), "--port", "0", *told])
    assert "that is enough" in result.stderr
    assert made == [reproducible]
