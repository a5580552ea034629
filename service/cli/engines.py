"""Which engine a command runs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

if TYPE_CHECKING:
    from looktwice.model.engines.engine import Engine

EngineName = Annotated[
    Literal["torch", "vllm", "transformers"],
    typer.Option(
        "--engine",
        help="torch is built in; vllm for large ones; transformers for foreign ones, without shortcuts.",
    ),
]
Formats = Annotated[
    list[str] | None,
    typer.Option(
        "--format",
        help="Response format that a foreign checkpoint is to write; again for more, the first by default. "
        "Not for LookTwice's own.",
    ),
]
Device = Annotated[Literal["cpu", "cuda"], typer.Option(help="Where the torch engine runs.")]
VllmArguments = Annotated[
    str, typer.Option(help='More of vLLM\'s engine arguments as JSON, such as {"tensor_parallel_size": 2}.')
]
Rows = Annotated[int, typer.Option(help="Draws decoded at once.", min=1)]
CacheMb = Annotated[
    int,
    typer.Option(
        help="MB for what the torch engine keeps of pictures that may come again; twice, tokens and keys.",
        min=0,
    ),
]
Reproducible = Annotated[
    bool | None,
    typer.Option(
        "--reproducible/--fast",
        help="torch: the same request gets the same bytes, whatever else runs, or decode as fast as can be; "
        "by default reproducible on a CPU and fast on a GPU.",
        show_default=False,
    ),
]


def make_engine(
    checkpoint: Path,
    rows: int,
    *,
    name: Literal["torch", "vllm", "transformers"] = "torch",
    device: Literal["cpu", "cuda"] = "cpu",
    vllm_arguments: str = "{}",
    cache_mb: int = 256,
    reproducible: bool | None = None,
    formats: Sequence[str] | None = None,
) -> Engine:
    """An engine over a checkpoint, not started yet.

    ``cache_mb`` is for the vision tokens that the torch engine keeps, and as much for keys and values;
    ``reproducible`` None is what suits the device; a foreign checkpoint writes ``formats``.

    Raises:
        CheckpointError: the folder is no usable checkpoint, or another engine runs it.
        FamilyError: there is no such format.
        ValueError: ``vllm_arguments`` are no JSON object.
    """
    from looktwice.model.network.card import CheckpointError, is_foreign

    if name != "transformers" and (formats or is_foreign(checkpoint)):
        raise CheckpointError(
            f"{checkpoint}: the {name} engine runs LookTwice's own checkpoints, which name their formats; "
            "foreign ones need --engine transformers and --format NAME"
        )
    if name == "vllm":
        from looktwice.model.engines.vllm.engine import VllmEngine, VllmSettings

        try:
            arguments: Any = json.loads(vllm_arguments)
        except json.JSONDecodeError as error:
            raise ValueError(f"--vllm-arguments are no JSON: {error}") from error
        if not isinstance(arguments, dict):
            raise ValueError("--vllm-arguments must be a JSON object")
        return VllmEngine(checkpoint, VllmSettings(rows=rows, arguments=arguments))
    if name == "transformers":
        from looktwice.model.engines.transformers.engine import TransformersEngine

        return TransformersEngine(checkpoint, rows, formats=formats or ())
    import torch

    from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings

    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("there is no CUDA device that this torch can use; leave out --device cuda")
    settings = replace(TorchSettings.on(device, rows), clip_bytes=cache_mb << 20)
    if reproducible is not None:
        settings = replace(settings, reproducible=reproducible)
    return TorchEngine(checkpoint, settings)
