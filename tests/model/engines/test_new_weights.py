"""Behind new weights nothing is left of the old ones: draws are those of a new decoder, to the last bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from looktwice.model.engines.engine import EngineError
from looktwice.model.engines.torch.decoder import Decoder
from looktwice.model.engines.torch.runner import Runner
from looktwice.model.network.checkpoint import load
from tests.checkpoints import shake, write_untrained
from tests.model.engines.decoding import Again, decode, request

pytestmark = pytest.mark.usefixtures("inference")

# The same pictures again and again: what was kept of them would be used.
REQUESTS = [
    request("a", 0, n=2, seed=1, thinking="always", logprobs=True),
    request("b", 0, "traj_only", n=2, seed=2, logprobs=True),
    request("c", 1, n=3, seed=3, logprobs=True),
]
Bits = dict[tuple[str, int], tuple[tuple[int, ...], tuple[float | None, ...]]]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_untrained(tmp_path_factory.mktemp("narrow") / "untrained", narrow=True)


def bits(decoder: Decoder) -> Bits:
    """Tokens, and how likely they were, which every weight has a part in."""
    return {key: (draw.ids, draw.logprobs) for key, draw in decode(decoder, *REQUESTS).items()}


@pytest.mark.parametrize(
    "options",
    [
        {"capture": Again},
        {"reproducible": True},
        {"reproducible": True, "products": torch.bfloat16},
        {"reuse": False},
    ],
    ids=lambda options: "-".join(options),
)
def test_draws_are_those_of_a_new_decoder(checkpoint: Path, options: dict[str, Any]) -> None:
    loaded = load(checkpoint)
    decoder = Decoder(Runner(loaded, 14, clip_bytes=1 << 20, **options))
    # What comes again is captured, guessed and taken from memory.
    old = [bits(decoder) for _ in range(2)][-1]
    shake(loaded.model)
    decoder.renew()
    new = bits(decoder)
    assert new == bits(Decoder(Runner(loaded, 14, clip_bytes=1 << 20, **options)))
    assert all(new[key] != old[key] for key in old)


def test_weights_do_not_change_under_a_request(checkpoint: Path) -> None:
    decoder = Decoder(Runner(load(checkpoint), 8))
    decoder.add(REQUESTS[0])
    decoder.step()
    with pytest.raises(EngineError, match="while there are no requests"):
        decoder.renew()
    while not decoder.idle:
        decoder.step()
    decoder.renew()
