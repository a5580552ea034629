"""Logits of sets of ids, whoever makes the sets."""

from __future__ import annotations

import numpy as np
import torch

from looktwice.model.engines.torch.head import AllowedHead

VOCABULARY, HIDDEN = 400, 8


def test_sets_that_are_made_anew_each_time_are_known_again() -> None:
    """As a fork of the response language makes them: what is kept must not grow with every pass."""
    draw = torch.Generator().manual_seed(0)
    weight = torch.randn(VOCABULARY, HIDDEN, generator=draw)
    head, kept = AllowedHead(weight), set[int]()
    for _ in range(20):
        hidden = torch.randn(3, HIDDEN, generator=draw)
        few, many = np.array([3, 5, 300], np.int64), np.arange(1, VOCABULARY)
        wanted = [few, many.copy(), few.copy()]
        for ids, found, row in zip(wanted, head.logits(hidden, wanted), hidden, strict=True):
            expected = (weight[torch.from_numpy(ids)] @ row).numpy()
            np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
        kept.add(len(head._parts))
    assert kept == {2}
