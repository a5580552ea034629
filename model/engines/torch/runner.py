"""Network passes: a scene's prompt in chunks, running draws their next tokens. Owns network and memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from model.driving.scene import Scene
from model.engines.torch.attention import DrawPass, Fed, PromptPass
from model.engines.torch.clips import ClipCache, Pictures
from model.engines.torch.head import AllowedHead, Ids
from model.engines.torch.kv import KvRows
from model.engines.torch.packed import PackedDecoder, Rotation
from model.formats.cf_vla import FORMATS
from model.formats.cursor import CompiledFormat
from model.network.checkpoint import Loaded


@dataclass(eq=False)
class Prompt:
    """A prompt on its way into its row, all but its last token, which draws begin with.

    Attributes:
        row: of the prompts' memory.
        embeddings: [t, hidden] of the tokens to hold.
        rotation: theirs.
        held: how many of them are in the row.
        last_token: still to be fed.
        position_offset: see `model.network.inputs.Prompt`.
    """

    row: int
    embeddings: Tensor
    rotation: Rotation
    held: int
    last_token: int
    position_offset: int

    @property
    def ready(self) -> bool:
        """Whether draws can begin."""
        return self.held == len(self.embeddings)


class Feed(NamedTuple):
    """What a draw's row feeds in a pass.

    Attributes:
        prompt: of the row.
        held: tokens that the row holds.
        tokens: at least one.
        wanted: places among the tokens, ascending, and the ids whose logits behind them are asked for.
    """

    prompt: Prompt
    held: int
    tokens: Sequence[int]
    wanted: Sequence[tuple[int, Ids]]


def pass_size(count: int) -> int:
    """Tokens that a pass with ``count`` of them is padded to: one of few sizes, at most a quarter too large.

    For every new size of a product in bfloat16 a CPU's library makes a kernel first, which takes as long
    as using it forty times.
    """
    step = 1 << max(0, (count - 1).bit_length() - 3)
    return -(-count // step) * step


class Runner:
    """Owns the network, keys and values. Call under `torch.inference_mode`.

    Args:
        loaded: its weights must not change while the runner is used.
        rows: draws that can run at once, each with a prompt of its own if need be.
        clip_bytes: of vision tokens kept for pictures that come again.
        products: what matrix products are worked out in; None for the weights' own type.
    """

    def __init__(
        self,
        loaded: Loaded,
        rows: int,
        *,
        clip_bytes: int = 0,
        products: torch.dtype | None = None,
    ) -> None:
        self.loaded = loaded
        self.rows = rows
        self.formats = {
            name: CompiledFormat(FORMATS[name], loaded.vocabulary) for name in loaded.card.formats
        }
        # A draw's row holds the prompt's last token too.
        length = 1 + max(format.longest() for format in self.formats.values())
        model: Any = loaded.model
        text = model.config.text_config
        self._products = products
        self._decoder = PackedDecoder(model.model.language_model, products)
        self._head = AllowedHead(model.lm_head.weight)
        self._clips = ClipCache(clip_bytes)
        kept = [
            len(loaded.inputs.prompt(format, route=route).ids) - 1
            for format in loaded.card.formats
            for route in {False, loaded.settings.with_route}
        ]
        sizes = {
            "layers": text.num_hidden_layers,
            "heads": text.num_key_value_heads,
            "head_dim": text.hidden_size // text.num_attention_heads,
            "dtype": products or loaded.model.dtype,
            "device": loaded.model.device,
        }
        self._prompts = KvRows(rows=rows, length=max(kept), **sizes)
        self._draws = KvRows(rows=rows, length=length, **sizes)
        every_place = torch.arange(max(kept) + 1 + length, device=loaded.model.device)
        self._rotation = self._decoder.rotation(every_place.expand(3, -1))
        self._heads: dict[str, tuple[Tensor, Tensor]] = {}

    def begin_prompt(self, scene: Scene, format: str, row: int) -> Prompt:
        """A scene's prompt, its pictures encoded, nothing of it in its row but what all scenes share.

        Raises:
            ValueError: the scene cannot be made into inputs (missing camera, damaged picture).
        """
        loaded = self.loaded
        route = scene.route if loaded.settings.with_route else None
        prompt = loaded.inputs.prompt(format, route=route is not None)
        vision_tokens = self._clips.tokens(loaded.inputs.slices(scene), self._encode)
        embedded = loaded.model.embed_prompt(prompt, torch.cat(vision_tokens), scene.history, route)
        rotation = self._decoder.rotation(embedded.position_ids)
        kept = len(prompt.ids) - 1
        begun = Prompt(
            row,
            embedded.embeddings[:kept],
            Rotation(*(part[:kept] for part in rotation)),
            0,
            int(prompt.ids[-1]),
            prompt.position_offset,
        )
        is_video = prompt.ids == loaded.model.config.video_token_id
        self._begin_with_head(begun, format, int(is_video.argmax()))
        return begun

    def feed_prompt(self, prompt: Prompt, count: int) -> None:
        """Run up to ``count`` more of a prompt's tokens into its row."""
        end = min(prompt.held + count, len(prompt.embeddings))
        part = slice(prompt.held, end)
        attention = PromptPass(self._prompts, prompt.row, prompt.held, end - prompt.held)
        rotation = Rotation(*(values[part] for values in prompt.rotation))
        self._decoder(prompt.embeddings[part], rotation, attention)
        prompt.held = end

    def copy_row(self, source: int, target: int, length: int) -> None:
        """Make a draw's row hold what another holds in its first ``length`` places."""
        self._draws.copy(source, target, length)

    def move_prompt(self, prompt: Prompt, row: int) -> None:
        """Put a prompt into another row."""
        self._prompts.copy(prompt.row, row, prompt.held)
        prompt.row = row

    def feed(self, feeds: Sequence[Feed]) -> list[list[npt.NDArray[np.float64]]]:
        """Feed the first rows their next tokens in one pass; for each the logits wanted, float64 [k]."""
        device = self.loaded.model.device
        counts = [len(feed.tokens) for feed in feeds]
        ids = np.concatenate([feed.tokens for feed in feeds]).astype(np.int64)
        places = np.concatenate(
            [
                np.arange(feed.held, feed.held + count)
                + (len(feed.prompt.embeddings) + feed.prompt.position_offset)
                for feed, count in zip(feeds, counts, strict=True)
            ]
        )
        lengths = [0] * self.rows
        for feed in feeds:
            lengths[feed.prompt.row] = feed.prompt.held
        fed = [Fed(feed.prompt.row, feed.held, count) for feed, count in zip(feeds, counts, strict=True)]
        size = pass_size(len(ids))
        attention = DrawPass(self._decoder.heads, self._prompts, self._draws, fed, lengths, size)
        ids, places = (np.pad(each, (0, size - len(each))) for each in (ids, places))
        embeddings = self.loaded.model.get_input_embeddings()(torch.from_numpy(ids).to(device))
        hidden = self._decoder(embeddings, self._rotation.at(torch.from_numpy(places).to(device)), attention)
        starts = np.cumsum(counts) - counts
        asked = [
            (row, int(starts[row]) + place, ids)
            for row, feed in enumerate(feeds)
            for place, ids in feed.wanted
        ]
        found: list[list[npt.NDArray[np.float64]]] = [[] for _ in feeds]
        if asked:
            at = torch.tensor([place for _, place, _ in asked], device=device)
            logits = self._head.logits(hidden.index_select(0, at), [ids for _, _, ids in asked])
            for (row, _, _), values in zip(asked, logits, strict=True):
                found[row].append(values)
        return found

    def _encode(self, slices: list[Pictures]) -> Sequence[Tensor]:
        """Vision tokens of slices, each [k, hidden]."""
        loaded = self.loaded
        patches = np.concatenate([loaded.inputs.patches(pictures) for pictures in slices])
        grid = torch.tensor([[1, *loaded.settings.grid[1:]]] * len(slices))
        device = loaded.model.device
        with torch.autocast(device.type, self._products, enabled=self._products is not None):
            tokens = loaded.model.vision(torch.from_numpy(patches).to(device), grid)
        return tokens.view(len(slices), -1, tokens.shape[-1]).unbind()

    def _begin_with_head(self, prompt: Prompt, format: str, count: int) -> None:
        memory = (self._prompts.keys, self._prompts.values)
        if format not in self._heads:
            self.feed_prompt(prompt, count)
            keys, values = (part[:, prompt.row, :, :count].clone() for part in memory)
            self._heads[format] = (keys, values)
            return
        for part, kept in zip(memory, self._heads[format], strict=True):
            part[:, prompt.row, :, :count] = kept
        prompt.held = count
