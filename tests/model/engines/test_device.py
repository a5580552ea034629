from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from looktwice.model.engines.engine import Controls, DrawFinished, PlanRequest
from looktwice.model.engines.torch.decoder import Decoder
from looktwice.model.engines.torch.graphs import Capture
from looktwice.model.engines.torch.runner import Runner
from looktwice.model.network.checkpoint import load
from tests.checkpoints import noisy_scene
from tests.model.engines.decoding import Again

_MOVES = {torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default}


class OneDevice(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Fails where an operation is given tensors of two devices, which a GPU would refuse."""

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        given = [each for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor) and each.dim()]
        assert func in _MOVES or len({each.device for each in given}) <= 1, func
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("capture", [None, Again])
def test_every_tensor_is_made_where_the_weights_are(
    untrained_checkpoint: Path, monkeypatch: pytest.MonkeyPatch, capture: Capture | None
) -> None:
    """With weights on the meta device, which stands for a GPU: it has shapes and no numbers."""
    loaded = load(untrained_checkpoint)
    model: Any = loaded.model
    loaded = replace(loaded, model=model.to("meta"))
    monkeypatch.setattr(Tensor, "cpu", lambda self: torch.zeros(self.shape, dtype=self.dtype))
    with torch.inference_mode(), OneDevice():  # type: ignore[no-untyped-call]
        runner = Runner(loaded, 4, clip_bytes=1 << 20, capture=capture)
        runner.warm_up(4)
        decoder = Decoder(runner)
        for scene, format in enumerate(("cf_vla", "traj_only")):
            decoder.add(PlanRequest(format, noisy_scene(scene, route=True), format, Controls(n=2)))
        events = [event for _ in range(12) for event in decoder.step()]
    assert sum(isinstance(event, DrawFinished) for _, event in events) == 2
