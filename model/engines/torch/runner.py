"""Network passes: a scene's prompt in chunks, running draws their next tokens. Owns network and memory."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional

from model.driving.scene import Scene
from model.driving.trajectory import FloatArray
from model.engines.torch.attention import DrawPass, DrawsInOrder, PromptPart, PromptPass, PromptsInOrder
from model.engines.torch.clips import ClipCache, digest
from model.engines.torch.frames import Frames
from model.engines.torch.graphs import Capture, Graphs, Numbers, Sizes
from model.engines.torch.head import AllowedHead, Ids
from model.engines.torch.kv import KvRows
from model.engines.torch.layout import Shape, Walk, alike, in_order, lean, padded, pass_size, reached
from model.engines.torch.packed import Attention, PackedDecoder, Rotation
from model.engines.torch.places import Fed, IntArray, Places, Written
from model.formats.cf_vla import FORMATS
from model.formats.cursor import CompiledFormat
from model.formats.pieces import Format
from model.network.checkpoint import Loaded

ROWS_A_PROMPT: Final = 12
"""Rows of draws, drafts among them, that one prompt's memory has room for."""


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
        shown: tells its format and pictures from others.
        pictures: tells apart what stands in the prompt for its pictures: with a resampler that depends on
            history and route as well.
        pictured: tokens up to the end of the pictures.
        end: of the places that draws have written to behind it.
    """

    row: int
    embeddings: Tensor
    rotation: Rotation
    held: int
    last_token: int
    position_offset: int
    shown: bytes
    pictures: bytes
    pictured: int
    end: int = 0

    @property
    def ready(self) -> bool:
        """Whether draws can begin."""
        return self.held == len(self.embeddings)


class Feed(NamedTuple):
    """What a draw's row feeds in a pass.

    Attributes:
        row: which it is.
        prompt: of the row.
        held: tokens that the row holds.
        tokens: at least one.
        wanted: places among the tokens, ascending, and the ids whose logits behind them are asked for.
    """

    row: int
    prompt: Prompt
    held: int
    tokens: Sequence[int]
    wanted: Sequence[tuple[int, Ids]]


class _Opened(NamedTuple):
    """A scene's slices by digest, the vision tokens that are kept, and the patches of the others."""

    keys: list[bytes]
    kept: dict[bytes, Tensor]
    patches: dict[bytes, npt.NDArray[np.uint8]]


class Runner:
    """Owns the network, keys and values. Call under `torch.inference_mode`.

    Args:
        loaded: its weights must not change while the runner is used.
        rows: draws that can run at once.
        prompts: that can be held at once, each with what up to `ROWS_A_PROMPT` rows write behind it; by
            default as many as rows.
        clip_bytes: of vision tokens kept for pictures that come again, and as many of keys and values.
        frames: where pictures are decoded; by default a new one.
        products: what matrix products are worked out in; None for the weights' own type.
        reproducible: whether a draw's numbers are the same to the last bit whatever else runs and whatever
            is known already; takes longer.
        reuse: whether anything is kept from scene to scene at all.
        capture: how passes of draws are captured, to be replayed for passes of the same sizes; None for not
            at all, which is best where an operation costs no more than what it does.
        formats: of them those that the checkpoint writes are served.

    Attributes:
        prompt_tokens: that the longest prompt holds.
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
        formats: Mapping[str, Format] = FORMATS,
    ) -> None:
        self.loaded = loaded
        self.rows, self.prompts = rows, prompts or rows
        self.formats = {
            name: CompiledFormat(formats[name], loaded.vocabulary) for name in loaded.card.formats
        }
        # A draw's row holds the prompt's last token too.
        length = 1 + max(format.longest() for format in self.formats.values())
        model: Any = loaded.model
        text = model.config.text_config
        self._products = products
        self._decoder = PackedDecoder(model.model.language_model, products)
        self._head = AllowedHead(model.lm_head.weight)
        self._reproducible = reproducible
        self._reuse, clip_bytes = reuse, clip_bytes if reuse else 0
        self._clips, self._pictures = ClipCache(clip_bytes), ClipCache(clip_bytes)
        self._frames = frames or Frames(loaded.inputs)
        tower = model.model.visual
        self._tower = tower if products is None else copy.deepcopy(tower).to(products)
        kept = [len(loaded.inputs.longest_prompt(format).ids) - 1 for format in loaded.card.formats]
        sizes = {
            "layers": text.num_hidden_layers,
            "heads": text.num_key_value_heads,
            "head_dim": text.hidden_size // text.num_attention_heads,
            "dtype": products or loaded.model.dtype,
            "device": loaded.model.device,
        }
        self.prompt_tokens = max(kept)
        self._memory = KvRows(rows=self.prompts, length=self.prompt_tokens + ROWS_A_PROMPT * length, **sizes)
        self._shape = Shape(self._decoder.heads, self._memory.heads, self._memory.rows, self._memory.length)
        self._arrange = lean if capture is None else alike
        self._pass = self._run_pass if capture is None else Graphs(self._run_pass, capture)
        self._places = Places(rows, length)
        every_place = torch.arange(max(kept) + 1 + length, device=loaded.model.device)
        self._rotation = self._decoder.rotation(every_place.expand(3, -1))
        self._heads: dict[str, Tensor] = {}

    def warm_up(self, tokens: int) -> None:
        """Make the kernels of passes with up to so many tokens."""
        self._decoder.warm_up(sorted({pass_size(count) for count in range(1, tokens + 1)}))

    def begin_prompts(self, scenes: Sequence[tuple[Scene, str]], first_row: int) -> list[Prompt | Exception]:
        """Prompts of scenes in formats, from ``first_row`` on, their pictures encoded all at once.

        Of each prompt its row holds what all scenes share. A scene that cannot be made into inputs (missing
        camera, damaged picture) gets its exception and no row.
        """
        opened = [self._open(scene) for scene, _ in scenes]
        new: dict[bytes, npt.NDArray[np.uint8]] = {}
        for each in opened:
            if not isinstance(each, Exception):
                new |= each.patches
        made = self._encode(new)
        begun: list[Prompt | Exception] = []
        row = first_row
        for (scene, format), each in zip(scenes, opened, strict=True):
            if isinstance(each, Exception):
                begun.append(each)
                continue
            tokens = [each.kept[key] if key in each.kept else made[key] for key in each.keys]
            shown = format.encode() + b"".join(each.keys)
            try:
                begun.append(self._begin_prompt(scene, format, row, torch.cat(tokens), shown))
            except Exception as error:  # one scene that cannot be embedded must not end the others
                begun.append(error)
                continue
            row += 1
        for key, vision_tokens in made.items():
            # A copy: a part of a tensor would keep all of it.
            self._clips.keep(key, vision_tokens.clone())
        return begun

    def feed_prompts(self, parts: Sequence[tuple[Prompt, int]]) -> None:
        """Run up to so many more of each prompt's tokens into its row, in one pass."""
        spans = [
            (prompt, slice(prompt.held, min(prompt.held + count, len(prompt.embeddings))))
            for prompt, count in parts
        ]
        kind = PromptsInOrder if self._reproducible else PromptPass
        attention = kind(
            self._memory,
            [PromptPart(prompt.row, span.start, span.stop - span.start) for prompt, span in spans],
        )
        embeddings = torch.cat([prompt.embeddings[span] for prompt, span in spans])
        rotations = zip(*([part[span] for part in prompt.rotation] for prompt, span in spans), strict=True)
        cosines, sines = (torch.cat(part) for part in rotations)
        padding = pass_size(len(embeddings)) - len(embeddings)
        embeddings = functional.pad(embeddings, (0, 0, 0, padding))
        rotation = Rotation(*(functional.pad(part, (0, 0, 0, 0, 0, padding)) for part in (cosines, sines)))
        self._decoder(embeddings, rotation, attention, None)
        for prompt, span in spans:
            prompt.held = span.stop
            if span.start < prompt.pictured <= span.stop:
                self._pictures.keep(prompt.pictures, self._held(prompt, prompt.pictured).clone())

    def copy_row(self, source: int, target: int) -> None:
        """Make a draw's row hold what another holds, behind the same prompt."""
        self._places.copy(source, target)

    def move_prompt(self, prompt: Prompt, row: int) -> None:
        """Put a prompt, and all that is written behind it, into another row."""
        self._memory.copy(prompt.row, row, max(prompt.held, prompt.end))
        prompt.row = row

    def wipe_prompt(self, prompt: Prompt) -> None:
        """Make nothing of a prompt's row, and of all that is written behind it."""
        self._memory.wipe(prompt.row)

    def feed(self, feeds: Sequence[Feed]) -> list[list[npt.NDArray[np.float64]]]:
        """Feed rows their next tokens in one pass, of a prompt all or none.

        Returns the logits that each wants, float64 [k].
        """
        counts = [len(feed.tokens) for feed in feeds]
        ids = np.concatenate([feed.tokens for feed in feeds]).astype(np.int64)
        places = np.concatenate(
            [
                np.arange(feed.held, feed.held + count)
                + (len(feed.prompt.embeddings) + feed.prompt.position_offset)
                for feed, count in zip(feeds, counts, strict=True)
            ]
        )
        prompts = {feed.prompt.row: feed.prompt for feed in feeds}
        lengths = [len(prompts[row].embeddings) if row in prompts else 0 for row in range(self.prompts)]
        fed = [
            Fed(feed.row, feed.prompt.row, feed.held, count)
            for feed, count in zip(feeds, counts, strict=True)
        ]
        written = self._places.write(fed, lengths)
        for prompt in prompts.values():
            prompt.end = max(prompt.end, written.seen.shape[1])
        starts = np.cumsum(counts) - counts
        asked = [
            (number, int(starts[number]) + place, ids)
            for number, feed in enumerate(feeds)
            for place, ids in feed.wanted
        ]
        size, wanted = pass_size(len(ids)), np.array([place for _, place, _ in asked], np.int64)
        numbers = [
            padded(ids, size, "edge"),
            padded(places, size, "edge"),
            padded(wanted, pass_size(len(asked)) if asked else 0, "edge"),
        ]
        if self._reproducible:
            hidden = self._in_order(fed, lengths, numbers)
        else:
            hidden = self._together(written, numbers)
        found: list[list[npt.NDArray[np.float64]]] = [[] for _ in feeds]
        if asked:
            logits = self._head.logits(hidden[: len(asked)], [ids for _, _, ids in asked])
            for (number, _, _), values in zip(asked, logits, strict=True):
                found[number].append(values)
        return found

    def _in_order(self, fed: Sequence[Fed], lengths: Sequence[int], numbers: Sequence[IntArray]) -> Tensor:
        """A pass in which each row looks by itself; ``numbers`` are ids, places and what is wanted."""
        walks = []
        for row, prompt, held, count in fed:
            own = self._places.path(row, held + count)
            walks.append(Walk(prompt, np.concatenate([np.arange(lengths[prompt]), own]), count))
        attention = DrawsInOrder(self._memory, in_order(self._shape, walks, len(numbers[0])))
        ids, places, wanted = map(torch.from_numpy, numbers)
        return self._hidden(ids, places, wanted, attention)

    def _together(self, written: Written, numbers: Sequence[IntArray]) -> Tensor:
        """A pass in which the rows of a scene look together; ``numbers`` as there."""
        device = self.loaded.model.device
        layout = self._arrange(self._shape, written, len(numbers[0]))
        every = [*numbers, layout.slots, layout.into, layout.back]
        # Before the pass, which may be a replay, in which nothing new is made zero.
        self._memory.reach(*reached(layout.parts))
        return self._pass(
            Sizes(layout.parts, tuple(map(len, every))),
            Numbers(
                # Few copies: on a GPU each costs as much as an operation.
                torch.from_numpy(np.concatenate(every)).to(device),
                torch.from_numpy(layout.hidden).to(device),
            ),
        )

    def _run_pass(self, sizes: Sizes, numbers: Numbers) -> Tensor:
        """Final hidden states of the tokens that are asked for, [k, hidden]."""
        ids, places, wanted, slots, into, back = torch.split(numbers.whole, list(sizes.numbers))
        attention = DrawPass(
            self._decoder.heads,
            self._memory,
            sizes.parts,
            slots=slots,
            into=into,
            back=back,
            hidden=numbers.hidden,
        )
        return self._hidden(ids, places, wanted, attention)

    def _hidden(self, ids: Tensor, places: Tensor, wanted: Tensor, attention: Attention) -> Tensor:
        device = self.loaded.model.device
        embeddings = self.loaded.model.get_input_embeddings()(ids.to(device))
        rotation = self._rotation.at(places.to(device))
        return self._decoder(embeddings, rotation, attention, wanted.to(device) if len(wanted) else None)

    def _open(self, scene: Scene) -> _Opened | Exception:
        """A scene's pictures: what is kept of them, and the patches of the others."""
        try:
            slices = self.loaded.inputs.slices(scene)
            keys = [digest(pictures) for pictures in slices]
            kept = {key: tokens for key in keys if (tokens := self._clips.find(key)) is not None}
            patches = {
                key: self._frames.patches(pictures)
                for key, pictures in zip(keys, slices, strict=True)
                if key not in kept
            }
        except Exception as error:  # one scene that cannot be read must not end the others
            return error
        return _Opened(keys, kept, patches)

    def _encode(self, patches: Mapping[bytes, npt.NDArray[np.uint8]]) -> dict[bytes, Tensor]:
        """Vision tokens of slices, each [k, hidden]."""
        if not patches:
            return {}
        loaded = self.loaded
        at_once = 1 if self._reproducible else len(patches)
        grid = torch.tensor([[1, *loaded.settings.grid[1:]]] * at_once)
        tokens = [
            loaded.model.vision(
                torch.from_numpy(np.concatenate(some)).to(loaded.model.device), grid, self._tower
            )
            for some in _batches(list(patches.values()), at_once)
        ]
        return dict(zip(patches, torch.cat(tokens).tensor_split(len(patches)), strict=True))

    def _begin_prompt(
        self, scene: Scene, format: str, row: int, vision_tokens: Tensor, shown: bytes
    ) -> Prompt:
        loaded = self.loaded
        route, tracks = loaded.inputs.way(scene), loaded.inputs.tracks(scene)
        prompt = loaded.inputs.prompt(format, route=route is not None, tracks=tracks is not None)
        embedded = loaded.model.embed_prompt(prompt, vision_tokens, scene.history, route, tracks)
        rotation = self._decoder.rotation(embedded.position_ids)
        kept = len(prompt.ids) - 1
        clips = np.flatnonzero(prompt.ids == loaded.model.config.video_token_id)
        begun = Prompt(
            row,
            embedded.embeddings[:kept],
            Rotation(*(part[:kept] for part in rotation)),
            0,
            int(prompt.ids[-1]),
            prompt.position_offset,
            shown,
            shown + _gathered_with(scene.history, route) if loaded.settings.scene_tokens else shown,
            int(clips[-1]) + 1,
        )
        if self._reuse:
            self._begin_with_shared(begun, format, int(clips[0]))
        return begun

    def _begin_with_shared(self, prompt: Prompt, format: str, count: int) -> None:
        """Fill a prompt's row with what is known already.

        That is all up to the end of its pictures where these were seen lately, or else the ``count`` tokens
        that all prompts of a format begin with.
        """
        kept = self._pictures.find(prompt.pictures)
        if kept is None:
            kept = self._heads.get(format)
        if kept is None:
            self.feed_prompts([(prompt, count)])
            self._heads[format] = self._held(prompt, count).clone()
            return
        prompt.held = kept.shape[-2]
        self._held(prompt, prompt.held).copy_(kept)

    def _held(self, prompt: Prompt, count: int) -> Tensor:
        """A prompt's first keys and values, [2, layers, heads, count, head_dim]."""
        return self._memory.row(prompt.row, count)


def _gathered_with(history: FloatArray, route: FloatArray | None) -> bytes:
    """What else decides what a resampler gathers from pictures."""
    return history.tobytes() + (b"" if route is None else route.tobytes())


def _batches(patches: list[npt.NDArray[np.uint8]], count: int) -> list[list[npt.NDArray[np.uint8]]]:
    return [patches[first : first + count] for first in range(0, len(patches), count)]
