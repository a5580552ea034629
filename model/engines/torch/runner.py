"""Network passes: a scene's prompt in chunks, running draws their next tokens. Owns network and memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional

from looktwice.model.driving.scene import Scene
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.engines.torch.batch import Batch
from looktwice.model.engines.torch.cached_attention import (
    DecodeAttention,
    OrderedDecode,
    OrderedPrefill,
    PrefillAttention,
    PrefillChunk,
)
from looktwice.model.engines.torch.clips import ClipCache
from looktwice.model.engines.torch.graphs import Capture, Graphs, Numbers, Sizes
from looktwice.model.engines.torch.head import AllowedHead
from looktwice.model.engines.torch.kv import KvRows
from looktwice.model.engines.torch.kv_memory import IntArray, Memory, SlotMapping
from looktwice.model.engines.torch.layout import (
    RowPath,
    Shape,
    bucket,
    bucketed_layout,
    compact_layout,
    ordered_layout,
    padded,
    reached,
    repeatable_bucket,
)
from looktwice.model.engines.torch.packed import Attention, PackedDecoder, Rotation
from looktwice.model.engines.torch.picture_cache import Frames
from looktwice.model.engines.torch.vision_tokens import Encoded, VisionEncoder
from looktwice.model.families.family import Attempt, Family, PictureRequest
from looktwice.model.families.registry import families_of
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.network.checkpoint import Loaded

ROWS_A_TREE: Final = 12
"""Rows, drafts among them, that share a KV row at first."""
USUAL_TOKENS: Final = 128
"""Of a response. A KV row has room for so many of each of its rows; what outgrows it takes another one."""


class PromptRequest(NamedTuple):
    """All that decides a prompt, and the KV row that it goes to."""

    scene: Scene
    format: str
    kv_row: int
    attempt: Attempt | None = None
    view: PictureRequest | None = None


@dataclass(eq=False)
class PromptPrefill:
    """A prompt on its way into its KV row, all but its last token, which rows begin with.

    Attributes:
        kv_row: that it lies in, from the first slot on.
        embeddings: [t, hidden] of the tokens to be prefilled.
        rotation: theirs.
        held: how many of them are prefilled.
        last_token: still to be fed.
        position_offset: see `looktwice.model.network.inputs.Prompt`.
        shown: tells its format and pictures from others.
        pictures: tells apart what stands in the prompt for its pictures: with a resampler that depends on
            history and route as well.
        pictured: tokens up to the end of the pictures.
        facts: float32 [len(FACTS)] that are read from the pictures; None where the network reads none.
    """

    kv_row: int
    embeddings: Tensor
    rotation: Rotation
    held: int
    last_token: int
    position_offset: int
    shown: bytes
    pictures: bytes
    pictured: int
    facts: FloatArray | None = None

    @property
    def length(self) -> int:
        """Tokens to be prefilled."""
        return len(self.embeddings)

    @property
    def ready(self) -> bool:
        """Whether all of them are, so that rows can be fed."""
        return self.held == self.length


class Runner:
    """Owns the network, keys and values; a `Memory` says what lies where. Call under `torch.inference_mode`.

    Args:
        loaded: where its weights change, `renew` comes before the next call.
        rows: draws that can run at once.
        prompts: KV rows, each for a prompt and what usually `ROWS_A_TREE` rows write behind it; by default as
            many as rows.
        clip_bytes: of vision tokens kept for pictures that come again, and as many of keys and values.
        frames: where pictures are decoded; by default a new one.
        products: what matrix products are worked out in; None for the weights' own type.
        reproducible: whether a draw's numbers are the same to the last bit whatever else runs and whatever
            is known already; takes longer.
        reuse: whether anything is kept from scene to scene at all.
        capture: how passes of draws are captured, to be replayed for passes of the same sizes; None for not
            at all, which is best where an operation costs no more than what it does.
        families: of the formats that the checkpoint writes; None for those that are registered.
        usual_tokens: of a response; what KV rows have room for, see `USUAL_TOKENS`.

    Attributes:
        prompt_tokens: that the longest prompt holds.
        row_tokens: that the longest response holds, the prompt's last token among them.
        kv_length: slots of a KV row.
    """

    def __init__(
        self,
        loaded: Loaded,
        rows: int,
        *,
        prompts: int | None = None,
        clip_bytes: int = 0,
        frames: Frames | None = None,
        products: torch.dtype | None = None,
        reproducible: bool = False,
        reuse: bool = True,
        capture: Capture | None = None,
        families: Mapping[str, Family] | None = None,
        usual_tokens: int = USUAL_TOKENS,
    ) -> None:
        self.loaded = loaded
        self.rows, self.prompts = rows, prompts or rows
        self.families = families or families_of(loaded.card.formats, loaded.settings.reflection)
        self.formats = {
            name: CompiledFormat(family.format, loaded.vocabulary) for name, family in self.families.items()
        }
        # A row holds the prompt's last token too.
        self.row_tokens = 1 + max(format.longest() for format in self.formats.values())
        # An empty `Frames` is false.
        self._frames = Frames(loaded.inputs) if frames is None else frames
        self._clip_bytes = clip_bytes if reuse else 0
        self._products, self._reproducible, self._reuse = products, reproducible, reuse
        self._pass_size = repeatable_bucket if reproducible else bucket
        self._capture = capture
        self.renew()
        model: Any = loaded.model
        text = model.config.text_config
        kept = [loaded.inputs.longest_prompt(format) - 1 for format in loaded.card.formats]
        sizes = {
            "layers": text.num_hidden_layers,
            "heads": text.num_key_value_heads,
            "head_dim": text.hidden_size // text.num_attention_heads,
            "dtype": products or loaded.model.dtype,
            "device": loaded.model.device,
        }
        self.prompt_tokens = max(kept)
        # Room for what rows usually take, but for one row of the longest response in any case.
        usual = ROWS_A_TREE * min(usual_tokens, self.row_tokens)
        self.kv_length = self.prompt_tokens + max(self.row_tokens, usual)
        self._memory = KvRows(rows=self.prompts, length=self.kv_length, **sizes)
        self._shape = Shape(self._decoder.heads, self._memory.heads, self._memory.rows, self._memory.length)
        self._layout = compact_layout if capture is None else bucketed_layout
        every_position = torch.arange(self.prompt_tokens + 1 + self.row_tokens, device=loaded.model.device)
        self._rotation = self._decoder.rotation(every_position.expand(3, -1))

    def renew(self) -> None:
        """Take the network's weights as they are now: all that was made of others is made anew or dropped.

        No prompt that was begun before may be fed any more, nor rows behind it.
        """
        model: Any = self.loaded.model
        self._decoder = PackedDecoder(
            model.model.language_model, self._products, repeatable=self._reproducible
        )
        self._head = AllowedHead(model.lm_head.weight)
        self._vision = VisionEncoder(
            self.loaded,
            self._frames,
            clip_bytes=self._clip_bytes,
            products=self._products,
            one_by_one=self._reproducible,
        )
        self._pictures, self._heads = ClipCache(self._clip_bytes), dict[str, Tensor]()
        # Captured passes read the packed weights where they were.
        self._pass = self._run_pass if self._capture is None else Graphs(self._run_pass, self._capture)

    def memory(self) -> Memory:
        """An empty slot table for the keys and values of this runner."""
        return Memory(
            rows=self.rows, row_tokens=self.row_tokens, kv_rows=self.prompts, kv_length=self.kv_length
        )

    def warm_up(self, tokens: int) -> None:
        """Make the kernels of passes with up to so many tokens."""
        self._decoder.warm_up(sorted({bucket(count) for count in range(1, tokens + 1)}))

    def begin_prompts(self, asked: Sequence[PromptRequest]) -> list[PromptPrefill | Exception]:
        """Begin to prefill scenes, their pictures encoded all at once.

        Of each prompt its KV row holds what is known already. A scene that cannot be made into inputs (a
        missing camera, a damaged picture) gets its exception.

        Args:
            asked: scenes with all that decides their prompts.
        """
        pictures = self._vision.encode([each.scene for each in asked])
        begun: list[PromptPrefill | Exception] = []
        for each, encoded in zip(asked, pictures, strict=True):
            if isinstance(encoded, Exception):
                begun.append(encoded)
                continue
            try:
                begun.append(self._begin_prompt(each, encoded))
            except Exception as error:  # one scene that cannot be embedded must not end the others
                begun.append(error)
        return begun

    def feed_prompts(self, parts: Sequence[tuple[PromptPrefill, int]]) -> None:
        """Run up to so many more of each prompt's tokens into its row, in one pass."""
        spans = [
            (prompt, slice(prompt.held, min(prompt.held + count, len(prompt.embeddings))))
            for prompt, count in parts
        ]
        kind = OrderedPrefill if self._reproducible else PrefillAttention
        attention = kind(
            self._memory,
            [PrefillChunk(prompt.kv_row, span.start, span.stop - span.start) for prompt, span in spans],
        )
        embeddings = torch.cat([prompt.embeddings[span] for prompt, span in spans])
        rotations = zip(*([part[span] for part in prompt.rotation] for prompt, span in spans), strict=True)
        cosines, sines = (torch.cat(part) for part in rotations)
        padding = self._pass_size(len(embeddings)) - len(embeddings)
        embeddings = functional.pad(embeddings, (0, 0, 0, padding))
        rotation = Rotation(*(functional.pad(part, (0, 0, 0, 0, 0, padding)) for part in (cosines, sines)))
        self._decoder(embeddings, rotation, attention, None)
        for prompt, span in spans:
            prompt.held = span.stop
            if span.start < prompt.pictured <= span.stop:
                self._pictures.keep(prompt.pictures, self._held(prompt, prompt.pictured).clone())

    def wipe(self, kv_row: int) -> None:
        """Zero a KV row: what is no number must not be read, not even with a weight of zero."""
        self._memory.wipe(kv_row)

    def feed(self, batch: Batch) -> list[list[npt.NDArray[np.float64]]]:
        """Feed rows their next tokens in one pass.

        Returns:
            For each feed the logits that it wants, float64 [k].
        """
        feeds = batch.feeds
        counts = [len(feed.tokens) for feed in feeds]
        ids = np.concatenate([feed.tokens for feed in feeds]).astype(np.int64)
        positions = np.concatenate(
            [
                np.arange(feed.held, feed.held + count) + (feed.prompt.length + feed.prompt.position_offset)
                for feed, count in zip(feeds, counts, strict=True)
            ]
        )
        starts = np.cumsum(counts) - counts
        asked = [
            (number, int(starts[number]) + place, ids)
            for number, feed in enumerate(feeds)
            for place, ids in feed.wanted
        ]
        size, wanted = self._pass_size(len(ids)), np.array([place for _, place, _ in asked], np.int64)
        numbers = [
            padded(ids, size, "edge"),
            padded(positions, size, "edge"),
            padded(wanted, self._pass_size(len(asked)) if asked else 0, "edge"),
        ]
        if self._reproducible:
            hidden = self._in_order(batch, numbers)
        else:
            hidden = self._together(batch.mapping, numbers)
        found: list[list[npt.NDArray[np.float64]]] = [[] for _ in feeds]
        if asked:
            logits = self._head.logits(hidden[: len(asked)], [ids for _, _, ids in asked])
            for (number, _, _), values in zip(asked, logits, strict=True):
                found[number].append(values)
        return found

    def _in_order(self, batch: Batch, numbers: Sequence[IntArray]) -> Tensor:
        """A pass in which each row attends by itself; ``numbers`` are ids, positions and what is wanted."""
        paths = [
            RowPath(
                feed.prompt.kv_row,
                np.concatenate([np.arange(feed.prompt.length), path]),
                len(feed.tokens),
            )
            for feed, path in zip(batch.feeds, batch.mapping.paths, strict=True)
        ]
        attention = OrderedDecode(self._memory, ordered_layout(self._shape, paths, len(numbers[0])))
        ids, positions, wanted = map(torch.from_numpy, numbers)
        return self._hidden(ids, positions, wanted, attention)

    def _together(self, mapping: SlotMapping, numbers: Sequence[IntArray]) -> Tensor:
        """A pass in which the rows of a scene attend together; ``numbers`` as there."""
        device = self.loaded.model.device
        layout = self._layout(self._shape, mapping, len(numbers[0]))
        every = [*numbers, layout.slot_mapping, layout.query_index, layout.output_index]
        # Before the pass, which may be a replay, in which nothing new is made zero.
        self._memory.reach(*reached(layout.parts))
        return self._pass(
            Sizes(layout.parts, tuple(map(len, every))),
            Numbers(
                # Few copies: on a GPU each costs as much as an operation.
                torch.from_numpy(np.concatenate(every)).to(device),
                torch.from_numpy(layout.masked).to(device),
            ),
        )

    def _run_pass(self, sizes: Sizes, numbers: Numbers) -> Tensor:
        """Final hidden states of the tokens that are asked for, [k, hidden]."""
        ids, positions, wanted, slots, queries, outputs = torch.split(numbers.whole, list(sizes.numbers))
        attention = DecodeAttention(
            self._decoder.heads,
            self._memory,
            sizes.parts,
            slot_mapping=slots,
            query_index=queries,
            output_index=outputs,
            masked=numbers.masked,
        )
        return self._hidden(ids, positions, wanted, attention)

    def _hidden(self, ids: Tensor, positions: Tensor, wanted: Tensor, attention: Attention) -> Tensor:
        device = self.loaded.model.device
        embeddings = self.loaded.model.get_input_embeddings()(ids.to(device))
        rotation = self._rotation.at(positions.to(device))
        return self._decoder(embeddings, rotation, attention, wanted.to(device) if len(wanted) else None)

    def _begin_prompt(self, asked: PromptRequest, encoded: Encoded) -> PromptPrefill:
        loaded, (scene, format, kv_row, attempt, view) = self.loaded, asked
        route, tracks = loaded.inputs.route_of(scene), loaded.inputs.tracks(scene)
        prompt = loaded.inputs.prompt_for(scene, format, attempt, view)
        embedded = loaded.model.embed_prompt(prompt, encoded.tokens, scene.history, route, tracks)
        shown = format.encode() + encoded.digest
        rotation = self._decoder.rotation(embedded.position_ids)
        kept = len(prompt.ids) - 1
        clips = np.flatnonzero(prompt.ids == loaded.model.config.video_token_id)
        begun = PromptPrefill(
            kv_row,
            embedded.embeddings[:kept],
            Rotation(*(part[:kept] for part in rotation)),
            0,
            int(prompt.ids[-1]),
            prompt.position_offset,
            shown,
            shown + _gathered_with(scene.history, route) if loaded.settings.scene_tokens else shown,
            int(clips[-1]) + 1,
            loaded.model.read_facts(embedded.embeddings[int(clips[0]) : int(clips[-1]) + 1]),
        )
        if self._reuse:
            self._begin_with_shared(begun, format, int(clips[0]))
        return begun

    def _begin_with_shared(self, prompt: PromptPrefill, format: str, count: int) -> None:
        """Fill a prompt's row with what is known already.

        That is all up to the end of its pictures where these were seen lately, or else the ``count`` tokens
        that all prompts of a format begin with.
        """
        kept = self._pictures.get(prompt.pictures)
        if kept is None:
            kept = self._heads.get(format)
        if kept is None:
            self.feed_prompts([(prompt, count)])
            self._heads[format] = self._held(prompt, count).clone()
            return
        prompt.held = kept.shape[-2]
        self._held(prompt, prompt.held).copy_(kept)

    def _held(self, prompt: PromptPrefill, count: int) -> Tensor:
        """A prompt's first keys and values, [2, layers, heads, count, head_dim]."""
        return self._memory.row(prompt.kv_row, count)


def _gathered_with(history: FloatArray, route: FloatArray | None) -> bytes:
    """What else decides what a resampler gathers from pictures."""
    return history.tobytes() + (b"" if route is None else route.tobytes())
