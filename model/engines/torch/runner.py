"""Network passes over KV rows: prefill a scene's prompt, feed rows their next tokens."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from model.driving.scene import Scene
from model.engines.engine import EngineError
from model.engines.torch.kv_rows import KvRows, KvStep
from model.network.checkpoint import Loaded


class Prefilled(NamedTuple):
    """A prompt whose tokens but the last lie in a row.

    Attributes:
        held: tokens in the row.
        last_token: the prompt's last token, still to be fed.
        position_offset: see `model.network.inputs.Prompt`.
    """

    held: int
    last_token: int
    position_offset: int


class Runner:
    """Owns the network and the KV rows. Call under `torch.inference_mode`."""

    def __init__(self, loaded: Loaded, rows: int, length: int) -> None:
        self.loaded = loaded
        self.rows = rows
        text: Any = loaded.model.config.text_config
        self._kv = KvRows(
            layers=text.num_hidden_layers,
            heads=text.num_key_value_heads,
            head_dim=text.hidden_size // text.num_attention_heads,
            rows=rows,
            length=length,
            dtype=loaded.model.dtype,
            device=loaded.model.device,
        )

    def prefill(self, scene: Scene, format: str, row: int) -> Prefilled:
        """Run a scene's prompt, without its last token, into a row.

        Raises:
            ValueError: the scene cannot be made into inputs (missing camera, damaged picture).
        """
        inputs = self.loaded.inputs.build(scene, format)
        prompt = self.loaded.model.encode_prompt_embeddings(inputs)
        held = len(prompt.embeddings) - 1
        places = torch.arange(held, device=prompt.embeddings.device)[None]
        step = self._step(row, torch.tensor([held]), places)
        self._pass(prompt.embeddings[None, :held], prompt.position_ids[:, None, :held], step)
        return Prefilled(held, int(inputs.prompt.ids[-1]), prompt.position_offset)

    def copy_row(self, source: int, target: int, length: int) -> None:
        """Make a row hold what another holds in its first ``length`` places."""
        self._kv.copy(source, target, length)

    def decode(
        self, tokens: Sequence[Sequence[int]], held: Sequence[int], position_offsets: Sequence[int]
    ) -> npt.NDArray[np.float64]:
        """Feed the first ``len(tokens)`` rows their next tokens in one pass.

        Args:
            tokens: of each row, at least one.
            held: how many tokens each row holds already.
            position_offsets: of each row.

        Returns:
            Logits float64 [rows, vocabulary] behind each row's last token.
        """
        device = self.loaded.model.device
        width = max(map(len, tokens))
        ids = np.zeros((len(tokens), width), np.int64)
        places = np.full((len(tokens), width), -1, np.int64)
        for row, fed in enumerate(tokens):
            ids[row, : len(fed)] = fed
            places[row, : len(fed)] = held[row] + np.arange(len(fed))
        positions = np.maximum(places, 0) + np.array(position_offsets)[:, None]
        lengths = np.array(held) + np.array([len(fed) for fed in tokens])
        embeddings = self.loaded.model.get_input_embeddings()(torch.from_numpy(ids).to(device))
        step = self._step(0, torch.from_numpy(lengths), torch.from_numpy(places).to(device))
        rotary = torch.from_numpy(positions).to(device).expand(3, -1, -1)
        hidden = self._pass(embeddings, rotary, step)
        last = torch.tensor([len(fed) - 1 for fed in tokens], device=device)
        logits: Tensor = self.loaded.model.lm_head(hidden[torch.arange(len(tokens), device=device), last])
        return logits.double().cpu().numpy()

    def _step(self, first_row: int, lengths: Tensor, places: Tensor) -> KvStep:
        if int(lengths.max()) > self._kv.length:
            raise EngineError(f"a response outgrew its row of {self._kv.length} tokens")
        return self._kv.step(first_row, lengths, places)

    def _pass(self, embeddings: Tensor, position_ids: Tensor, step: KvStep) -> Tensor:
        output = self.loaded.model.model.language_model(
            inputs_embeds=embeddings,
            position_ids=position_ids,
            attention_mask={"full_attention": step.mask},
            past_key_values=step,
            use_cache=False,
        )
        hidden: Tensor = output.last_hidden_state
        return hidden
