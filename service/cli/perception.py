"""`looktwice evaluate --perception`: how well a checkpoint reads its pictures, and what that is worth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.scene_store import count_scenes, read_scenes
from looktwice.model.evaluation.perception import FactReadings, format_perception, perception_rows, read_facts
from looktwice.model.network.checkpoint import load
from looktwice.model.training.perception_gate import format_gate, perception_gate
from looktwice.model.training.small import SmallSettings
from looktwice.service.cli.progress import progress_on_stderr


def tell_perception(
    checkpoint: Path,
    scenes: Sequence[LabelledScene],
    gate_scenes: Path | None,
    gate_steps: int,
    *,
    quiet: bool,
) -> tuple[dict[str, Any], str]:
    """The table of every fact as JSON and as text; with ``gate_scenes`` to learn on, the gate's too.

    Raises:
        ValueError: the checkpoint has no resampler, or no scene has a route.
    """
    loaded = load(checkpoint)

    def reading(what: str, of: Iterable[LabelledScene], count: int) -> FactReadings:
        with progress_on_stderr(quiet=quiet) as progress:
            task = progress.add_task(what, total=count)
            return read_facts(loaded, of, lambda done: progress.update(task, completed=done))

    read = reading("scenes", scenes, len(scenes))
    rows = perception_rows(read)
    told, text = {"facts": rows}, format_perception(rows)
    if gate_scenes is not None:
        learned_on = reading("to learn on", read_scenes(gate_scenes, dense=False), count_scenes(gate_scenes))
        gate = perception_gate(learned_on, read, loaded.codec, SmallSettings(steps=gate_steps))
        told["gate"], text = gate, f"{text}\n\n{format_gate(gate)}"
    return told, text
