"""The network under training: batch in, loss out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from looktwice.model.engines.logprobs import log_probability
from looktwice.model.formats.replay import Decision
from looktwice.model.network.codec import TrajectoryCodec
from looktwice.model.network.motion import present_speeds
from looktwice.model.network.trajectory_head import TrajectoryHead
from looktwice.model.network.vla import LookTwiceVla
from looktwice.model.network.vocabulary import FUTURE_START, Vocabulary
from looktwice.model.training.batches import Batch
from looktwice.model.training.loss import response_loss

_PLACES_STEP: Final = 256
"""Predicted places are filled up to multiples of this, for the reason that `WIDTH_STEP` gives."""


class _ResponseLayout(NamedTuple):
    """How responses lie behind their prompts.

    Attributes:
        prompts: int64 [b], tokens of each prompt.
        moved: int64 [b, t], by how many places a response's tokens lie behind where they would without the
            responses before it.
        before: int64 [b * t], the place whose state predicts a token.
        mask: float [b, 1, t, t], added to scores: responses see their prompt and themselves. None where
            there is one response only: then all see what lies before them, and padding lies behind.
    """

    prompts: Tensor
    moved: Tensor
    before: Tensor
    mask: Tensor | None

    @classmethod
    def of(cls, parts: Tensor) -> _ResponseLayout:
        """From what each token belongs to; see `collate`."""
        rows, width = parts.shape
        place = torch.arange(width, device=parts.device)
        prompts = (parts == 0).sum(dim=1, keepdim=True)
        starts = (parts > 0) & (parts != parts.roll(1, dims=1))
        start = torch.where(starts, place, 0).cummax(dim=1).values
        before = torch.where(starts, prompts, place) - 1
        mask = None
        if int(parts.max()) > 1:
            seen = (parts[:, None] == 0) | (parts[:, None] == parts[:, :, None])
            seen &= place <= place[:, None]
            lowest = torch.finfo(torch.float32).min
            mask = torch.zeros(seen.shape, device=parts.device).masked_fill(~seen, lowest)[:, None]
        return cls(
            prompts[:, 0],
            torch.where(parts > 0, start - prompts, 0),
            (before + width * torch.arange(rows, device=parts.device)[:, None]).flatten(),
            mask,
        )


class ResponseLearner(nn.Module):
    """Predicts the tokens of responses; outputs the weighted token loss and its parts.

    The loss is worked out inside ``forward``, so wrappers (FSDP, DDP) see every use of the weights.

    Args:
        vla: trained in place.
        vocabulary: its codes and markers.
        codec: in whose space the head beside the codes draws trajectories.
        error_weight: see `response_loss`.
        head_weight: of the head's loss; 0 leaves it out.
        compiled: compile the decoder.
    """

    def __init__(
        self,
        vla: LookTwiceVla,
        vocabulary: Vocabulary,
        codec: TrajectoryCodec,
        *,
        error_weight: float = 0.0,
        head_weight: float = 0.0,
        compiled: bool = False,
    ) -> None:
        super().__init__()
        self.vla = vla
        text: Any = vla.config.text_config
        self.head = TrajectoryHead(text.hidden_size, codec) if head_weight else None
        self._error_weight, self._head_weight = error_weight, head_weight
        self._first_code_id = vocabulary.code_ids(0).start
        self._future_start_id = vocabulary.id_of(FUTURE_START)
        decoder = vla.model.language_model
        # Kept out of the registered modules: it is the same module, and must not be saved twice.
        self._decoder: list[Any] = [torch.compile(decoder) if compiled else decoder]

    def forward(
        self,
        input_ids: Tensor,
        parts: Tensor,
        loss_weights: Tensor,
        history: Tensor,
        route: Tensor,
        tracks: Tensor,
        futures: Tensor,
        code_shares: Tensor,
        code_errors_m: Tensor,
        seen: Tensor | None = None,
        patches: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """The loss of a batch from `collate`, and its parts: `ResponseLoss` and the head's ADE."""
        layout = _ResponseLayout.of(parts)
        hidden = self._hidden(layout, input_ids, parts, history, route, tracks, seen, patches)
        labels, weights = input_ids.flatten(), loss_weights.flatten()
        # Logits only where a token is predicted that counts: a third of the positions.
        places = weights.nonzero()[:, 0]
        filling = -len(places) % _PLACES_STEP
        logits = self.vla.lm_head(hidden.flatten(0, 1)[F.pad(layout.before[places], (0, filling))])
        labels, weights = F.pad(labels[places], (0, filling)), F.pad(weights[places], (0, filling))
        # The start of each trajectory in codes, which of them are to be learned, and whose they are.
        row, place = ((input_ids == self._future_start_id) & (parts > 0)).nonzero(as_tuple=True)
        learned = loss_weights[row, place + 1] > 0
        responses = parts.amax(dim=1).clamp_min(0)
        which = (responses.cumsum(0) - responses)[row] + parts[row, place] - 1
        losses = response_loss(
            logits,
            labels,
            weights,
            self._first_code_id,
            code_shares[which[learned]],
            code_errors_m[which[learned]],
            int(responses.sum()),
            self._error_weight,
        )._asdict()
        if self.head is not None:
            losses["head_ade_m"] = losses["loss"].new_zeros(())
        if self.head is not None and learned.any():
            # Where the first code is written, a trajectory is drawn at once: metres teach faster than codes.
            row, place = row[learned], place[learned]
            guesses = self.head(hidden[row, place].float())
            speeds = present_speeds(history)
            drawn = self.head.loss(guesses, speeds[row], futures[row])
            losses["loss"] = losses["loss"] + self._head_weight * drawn["loss"]
            losses["head_ade_m"] = drawn["ade_m"]
        return losses

    def log_probabilities(
        self, batch: Batch, responses: Sequence[Sequence[Decision]], temperature: float
    ) -> list[Tensor]:
        """How likely the decisions of a batch's responses are: [decisions] for each response, with gradients.

        Args:
            batch: from `collate`.
            responses: their decisions, row by row.
            temperature: that they were drawn at.
        """
        layout, hidden = self._read(batch)
        starts = _first_places(batch["parts"], batch["parts"] > 0)
        found = []
        for start, decisions in zip(starts, responses, strict=True):
            logits = self.vla.lm_head(hidden[layout.before[[start + each.position for each in decisions]]])
            each = [
                log_probability(
                    row[torch.from_numpy(decision.ids).to(row.device)], decision.place, temperature
                )
                for row, decision in zip(logits, decisions, strict=True)
            ]
            found.append(torch.stack(each))
        return found

    def states_before(self, batch: Batch, tokens: Tensor) -> Tensor:
        """The states [responses, hidden] that predict the first of ``tokens`` in each response of a batch."""
        layout, hidden = self._read(batch)
        places = _first_places(batch["parts"], torch.isin(batch["input_ids"], tokens))
        return hidden[layout.before[places]]

    def _read(self, batch: Batch) -> tuple[_ResponseLayout, Tensor]:
        """How the responses of a batch from `collate` lie, and its last states [b * t, hidden]."""
        layout = _ResponseLayout.of(batch["parts"])
        given = {name: batch.get(name) for name in ("history", "route", "tracks", "seen", "patches")}
        hidden = self._hidden(layout, batch["input_ids"], batch["parts"], **given)
        return layout, hidden.flatten(0, 1)

    def _hidden(
        self,
        layout: _ResponseLayout,
        input_ids: Tensor,
        parts: Tensor,
        history: Tensor | None,
        route: Tensor | None,
        tracks: Tensor | None,
        seen: Tensor | None,
        patches: Tensor | None,
    ) -> Tensor:
        """The last states [b, t, hidden] of a batch from `collate`."""
        vla = self.vla
        vision_tokens = None if seen is None else seen.flatten(0, 1)
        if patches is not None:
            grid = vla.settings.grid
            clips = len(patches) // (grid[0] * grid[1] * grid[2])
            vision_tokens = vla.vision(patches, torch.tensor([grid] * clips))
        # Mixed precision rounds a sketch by more than its tokens are wide, and targets are not rounded.
        with torch.autocast(input_ids.device.type, enabled=False):
            seen_tokens = None if vision_tokens is None else vision_tokens.float()
            embeddings = vla.embed(input_ids, seen_tokens, history, route, tracks)
        states: Tensor = self._decoder[0](
            inputs_embeds=embeddings,
            attention_mask=layout.mask,
            position_ids=vla.position_ids(input_ids, parts >= 0) - layout.moved,
            use_cache=False,
        ).last_hidden_state
        return states


def _first_places(parts: Tensor, counts: Tensor) -> list[int]:
    """Of each response of a batch, the first place that counts: into [b * t], see `collate` for ``parts``."""
    return [
        int(((row == part) & there).nonzero()[0]) + number * parts.shape[1]
        for number, (row, there) in enumerate(zip(parts, counts, strict=True))
        for part in range(1, int(row.max()) + 1)
    ]
