"""The network under training: batch in, loss out."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from model.network.vla import LookTwiceVla
from model.training.loss import response_loss


class ResponseLearner(nn.Module):
    """Predicts the tokens of responses; its only output is the weighted token loss.

    The loss is worked out inside ``forward``, so wrappers (FSDP, DDP) see every use of the weights.
    """

    def __init__(self, vla: LookTwiceVla, first_code_id: int, *, compiled: bool = False) -> None:
        super().__init__()
        self.vla = vla
        self._first_code_id = first_code_id
        decoder = vla.model.language_model
        # Kept out of the registered modules: it is the same module, and must not be saved twice.
        self._decoder: list[Any] = [torch.compile(decoder) if compiled else decoder]

    def forward(
        self,
        input_ids: Tensor,
        attention_mask: Tensor,
        loss_weights: Tensor,
        history: Tensor,
        route: Tensor,
        code_shares: Tensor,
        patches: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """The loss of a batch from `collate`; weights and ids are shifted against each other here."""
        vla = self.vla
        vision_tokens = None
        if patches is not None:
            grid = vla.settings.grid
            clips = len(patches) // (grid[0] * grid[1] * grid[2])
            vision_tokens = vla.vision(patches, torch.tensor([grid] * clips))
        embeddings = vla.embed(input_ids, vision_tokens, history, route)
        # No mask: padding lies on the right, where causal attention never looks.
        hidden = self._decoder[0](
            inputs_embeds=embeddings,
            attention_mask=None,
            position_ids=vla.position_ids(input_ids, attention_mask),
            use_cache=False,
        ).last_hidden_state
        # Logits only where a token is predicted that counts: a third of the positions.
        counts = loss_weights[:, 1:] > 0
        logits = vla.lm_head(hidden[:, :-1][counts])
        labels, weights = input_ids[:, 1:][counts], loss_weights[:, 1:][counts]
        return {"loss": response_loss(logits, labels, weights, self._first_code_id, code_shares)}
