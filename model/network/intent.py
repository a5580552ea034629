"""What to do about what is known, in a vector: a small planner inside the network.

A decoder learns from a few responses a second; a multilayer perceptron over history, route and what is
around learns from thousands, and plans in metres far better than a decoder that starts from nothing. So
this trunk learns first (recipes ``read-tracks`` and ``read-scene``), and its state stands in the prompt as
continuous tokens: the decoder only has to put it into words and codes. Beside it stands a sketch: the
trajectory that the state amounts to, in the decoder's own codes. And beside that may stand what else might be
driven (`looktwice.model.network.second_sketch`).
"""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
from torch import Tensor, nn

from looktwice.model.driving.tracks import MAX_TRACKS
from looktwice.model.network.codec import CURVE_VALUES, DIMENSIONS, TrajectoryCodec
from looktwice.model.network.motion import MOTION_FEATURES, motion_features, present_speeds
from looktwice.model.network.second_sketch import CurveSpace, Known, SecondSketcher
from looktwice.model.network.track_features import TRACK_FEATURES
from looktwice.model.network.trajectory_head import spread_of

INTENT_TOKENS: Final = 2
"""Tokens of the prompt that one state becomes, without those of its sketch."""
_TRACK_WIDTH: Final = 96
_WIDTH: Final = 256
_SOFTNESS: Final = 1e-3
"""Width of a sketch's mixtures, in mean squared distances from a code to the nearest other one: a few
centimetres. In wider ones the nearest code drowns: the later a token, the less of it can be copied."""


class TrackPool(nn.Module):
    """A set of tracks [b, 16, features] as one vector [b, 2 x 96], whatever their order."""

    size: Final = 2 * _TRACK_WIDTH

    def __init__(self) -> None:
        super().__init__()
        self.each = nn.Sequential(
            nn.Linear(len(TRACK_FEATURES) + 1, _TRACK_WIDTH),
            nn.SiLU(),
            nn.Linear(_TRACK_WIDTH, _TRACK_WIDTH),
            nn.SiLU(),
            nn.Linear(_TRACK_WIDTH, _TRACK_WIDTH),
        )

    def forward(self, tracks: Tensor, history: Tensor) -> Tensor:
        """The vector of each set; ``history`` [b, 16, 4] tells how fast the ego is."""
        speeds = (present_speeds(history) / 20)[:, None, None].expand(-1, MAX_TRACKS, 1)
        numbers = torch.cat([tracks, speeds.to(tracks.dtype)], dim=2)
        each = self.each(numbers.to(next(self.parameters()).dtype))
        there = tracks[..., :1].to(each.dtype)
        most = each.masked_fill(there == 0, -5.0).amax(dim=1)
        return torch.cat([most, (each * there).sum(dim=1) / 4], dim=1)


class IntentTrunk(nn.Module):
    """A multilayer perceptron from history, route and a vector of what is around to a state [b, 256].

    Args:
        around: size of the vector of what is around; 0 where nothing but history and route is known.
        dropout: in training.
    """

    width: Final = _WIDTH

    def __init__(self, around: int, dropout: float = 0.0) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for width in (MOTION_FEATURES + around, _WIDTH, _WIDTH):
            layers += [nn.Linear(width, _WIDTH), nn.LayerNorm(_WIDTH), nn.SiLU(), nn.Dropout(dropout)]
        self.layers = nn.Sequential(*layers[:-1])

    def forward(
        self, history: Tensor, route: Tensor, has_route: Tensor, around: Tensor | None = None
    ) -> Tensor:
        """States of a batch; see `motion_features`. ``around`` [b, size]."""
        features = motion_features(history, route, has_route)
        if around is not None:
            features = torch.cat([features, around.float()], dim=1)
        state: Tensor = self.layers(features.to(next(self.parameters()).dtype))
        return state


class SketchCodes(NamedTuple):
    """The codes that sketches are written in; a stage is one token of the prompt.

    Attributes:
        books: [stages, K, d], see `TrajectoryCodec`.
        widths: [stages], how far off, in squares, a code still has a share in a mixture.
        embeddings: [stages, K, hidden], the decoder's own of these codes.
        space: that the codec works in; None where there is no second sketch.
    """

    books: Tensor
    widths: Tensor
    embeddings: Tensor
    space: CurveSpace | None = None

    @property
    def spread(self) -> Tensor:
        """What sketches are told in, [d]; see `spread_of`."""
        return spread_of(self.books[0].float())

    def tokens(self, sketches: Tensor) -> Tensor:
        """Tokens [b, stages, hidden] of sketches [b, d], in spreads of the first stage's codes.

        Each is the embedding of the code nearest to what the stages before it left over. Where two codes
        are as near, it mixes them: unlike the nearest code alone, a mixture does not jump between engines.
        Behind a mixture, later tokens move more than the sketch does: rounding changes one in ten thousand.
        """
        books, widths = self.books.float(), self.widths.float()
        tokens = []
        # Differences of large squares decide: mixed precision would round them away.
        with torch.autocast(sketches.device.type, enabled=False):
            left = sketches.float() * self.spread
            for book, width, embeddings in zip(books, widths, self.embeddings, strict=True):
                nearness = (2 * left @ book.T - book.square().sum(dim=1)) / width
                shares = nearness.softmax(dim=1)
                tokens.append(shares.to(embeddings.dtype) @ embeddings)
                left = left - shares @ book
        return torch.stack(tokens, dim=1)


class SketchBooks(nn.Module):
    """The first codebooks of a checkpoint's codec, where its network can reach them.

    Args:
        stages: how many.
        size: codes a stage.
        curves: whether they bring the codec's space, which second sketches need.
    """

    def __init__(self, stages: int, size: int, *, curves: bool = False) -> None:
        super().__init__()
        # Weights and no buffers, since every engine loads weights; training has to leave them out.
        self.books = nn.Parameter(torch.zeros(stages, size, DIMENSIONS))
        self.widths = nn.Parameter(torch.ones(stages))
        self.mean = nn.Parameter(torch.zeros(CURVE_VALUES)) if curves else None
        self.axes = nn.Parameter(torch.zeros(DIMENSIONS, CURVE_VALUES)) if curves else None

    def codes(self, embeddings: Tensor) -> SketchCodes:
        """What sketches are written in; ``embeddings`` [stages * K, hidden] are a decoder's of the codes."""
        return SketchCodes(self.books, self.widths, embeddings.view(*self.books.shape[:2], -1), self.space)

    @property
    def space(self) -> CurveSpace | None:
        """That the codec works in, where these bring it."""
        return None if self.mean is None or self.axes is None else CurveSpace(self.mean, self.axes)

    @torch.no_grad()
    def fill(self, codec: TrajectoryCodec) -> None:
        """Take them from ``codec``; raises ValueError for one in a space of other dimensions."""
        if codec.books.shape[2] != DIMENSIONS:
            raise ValueError(f"sketches need a codec of {DIMENSIONS} dimensions, not {codec.books.shape[2]}")
        self.books.copy_(torch.from_numpy(codec.books[: len(self.books)]))
        if self.mean is not None and self.axes is not None:
            self.mean.copy_(torch.from_numpy(codec.mean))
            self.axes.copy_(torch.from_numpy(codec.axes))
        for width, book in zip(self.widths, self.books.float(), strict=True):
            apart = torch.cdist(book, book).fill_diagonal_(torch.inf).amin(dim=1)
            width.fill_(_SOFTNESS * apart.square().mean().clamp_min(1e-3))


class IntentReader(nn.Module):
    """A small planner whose state stands in the prompt.

    Args:
        hidden_size: of a token.
        around: size of the vector of what is around, see `IntentTrunk`.
        sketches: whether its sketch stands there too.
        second: and what else might be driven.
    """

    def __init__(self, hidden_size: int, around: int, *, sketches: bool, second: bool = False) -> None:
        super().__init__()
        self.trunk = IntentTrunk(around)
        self.tokens = nn.Linear(IntentTrunk.width, INTENT_TOKENS * hidden_size)
        self.sketch = nn.Linear(IntentTrunk.width, DIMENSIONS) if sketches else None
        self.second = SecondSketcher(hidden_size) if second else None

    def written(self, state: Tensor, codes: SketchCodes | None, known: Known) -> Tensor:
        """A state [b, 256] as tokens [b, `INTENT_TOKENS` and those of the sketches, hidden].

        Args:
            state: of the trunk.
            codes: that sketches are written in, where they are.
            known: what a second sketch is judged by.
        """
        tokens: Tensor = self.tokens(state)
        tokens = tokens.view(len(tokens), INTENT_TOKENS, tokens.shape[1] // INTENT_TOKENS)
        if self.sketch is None or codes is None:
            return tokens
        sketch = self.sketch(state)
        parts = [tokens, codes.tokens(sketch)]
        if self.second is not None:
            assert codes.space is not None, "second sketches need the codec's space"
            found = self.second(sketch.float() * codes.spread, codes.space, known)
            parts[0] = tokens + self.second.doubt(found).to(tokens.dtype)
            second = codes.tokens(found.vectors / codes.spread)
            parts += [self.second.token(found), self.second.marked(second)]
        return torch.cat([part.to(tokens.dtype) for part in parts], dim=1)


class TrackReader(IntentReader):
    """A scene's tracks as tokens of the prompt, read with the ego's history and route in mind."""

    def __init__(self, hidden_size: int, *, sketches: bool = False, second: bool = False) -> None:
        super().__init__(hidden_size, TrackPool.size, sketches=sketches, second=second)
        self.pool = TrackPool()

    def state(self, tracks: Tensor, history: Tensor, route: Tensor, has_route: Tensor) -> Tensor:
        """What to do, [b, 256]; see `forward`."""
        state: Tensor = self.trunk(history, route, has_route, self.pool(tracks, history))
        return state

    def forward(
        self,
        tracks: Tensor,
        history: Tensor,
        route: Tensor,
        has_route: Tensor,
        codes: SketchCodes | None = None,
    ) -> Tensor:
        """Tokens of the prompt; see `IntentReader.written`.

        Args:
            tracks: [b, 16, features] of `track_features`.
            history: [b, 16, 4].
            route: [b, 20, 2]; rows without one are ignored.
            has_route: bool [b].
            codes: that sketches are written in, where they are.
        """
        known = Known(history, route, has_route, tracks=tracks)
        return self.written(self.state(tracks, history, route, has_route), codes, known)
