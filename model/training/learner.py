"""The network under training: batch in, loss out."""

from __future__ import annotations

from typing import Any, Final

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.network.vla import LookTwiceVla
from model.training.loss import response_loss
from model.training.probe import SceneProbe

_PLACES_STEP: Final = 256
"""Predicted places are filled up to multiples of this, for the reason that `WIDTH_STEP` gives."""


class ResponseLearner(nn.Module):
    """Predicts the tokens of responses; outputs the weighted token loss and its parts.

    The loss is worked out inside ``forward``, so wrappers (FSDP, DDP) see every use of the weights.

    Args:
        vla: trained in place.
        first_code_id: the id of stage 0's code 0.
        probe: its loss is added; trained along.
        compiled: compile the decoder.
    """

    def __init__(
        self,
        vla: LookTwiceVla,
        first_code_id: int,
        *,
        probe: SceneProbe | None = None,
        compiled: bool = False,
    ) -> None:
        super().__init__()
        self.vla, self.probe = vla, probe
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
        facts: Tensor,
        futures: Tensor,
        patches: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """The loss of a batch from `collate`, and its parts: `ResponseLoss` and the probe's."""
        vla = self.vla
        vision_tokens = None
        if patches is not None:
            grid = vla.settings.grid
            clips = len(patches) // (grid[0] * grid[1] * grid[2])
            vision_tokens = vla.vision(patches, torch.tensor([grid] * clips))
        embeddings = vla.embed(input_ids, vision_tokens, history, route)
        # No mask: padding lies on the right, where causal attention never looks.
        outputs = self._decoder[0](
            inputs_embeds=embeddings,
            attention_mask=None,
            position_ids=vla.position_ids(input_ids, attention_mask),
            use_cache=False,
            output_hidden_states=self.probe is not None,
        )
        hidden = outputs.last_hidden_state
        labels, weights = input_ids[:, 1:].flatten(), loss_weights[:, 1:].flatten()
        # Logits only where a token is predicted that counts: a third of the positions.
        places = weights.nonzero()[:, 0]
        filling = -len(places) % _PLACES_STEP
        logits = vla.lm_head(hidden[:, :-1].flatten(0, 1)[F.pad(places, (0, filling))])
        labels, weights = F.pad(labels[places], (0, filling)), F.pad(weights[places], (0, filling))
        parts = response_loss(logits, labels, weights, self._first_code_id, code_shares)._asdict()
        if self.probe is not None:
            halfway = outputs.hidden_states[len(outputs.hidden_states) // 2]
            last_of_prompt = (loss_weights > 0).int().argmax(dim=1) - 1
            states = halfway[torch.arange(len(halfway), device=halfway.device), last_of_prompt]
            probed = self.probe(states, facts, futures)
            parts |= probed | {"loss": parts["loss"] + probed["loss"]}
        return parts
