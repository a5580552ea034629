"""Which examples share a batch, and how each is to be learned."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, cast

import numpy as np
import numpy.typing as npt
from torch.utils.data import BatchSampler, Sampler

_PLAIN_AN_ATTEMPT: Final = 4
"""So many plain examples take as long, and as much memory, as one with a draft and five sections on it."""
_CHANCES: Final = ("tracks", "mirror", "blur")
_ASKED_SHARE: Final = 0.8
"""Of the pictures that are taught: the prompt asks for their camera, and shows what is expected of it. Others
are of the model's own choice."""


@dataclass(frozen=True)
class Item:
    """Which example to learn from, and how.

    Attributes:
        index: of the example.
        task: the response format.
        route: whether the prompt has the example's route.
        tracks: whether it has its tracks.
        mirror: left and right are swapped.
        blur: of the history only the present speed is left.
        pictures: whether the prompt has the example's pictures, where any prompt has.
        camera: whose picture half a second later is taught; None for no picture.
        camera_requested: whether the prompt asks for that camera.
        reflections: places of reflections on it, whose responses all follow the same prompt; without any,
            the response is the expert's own.
        attempt: place of the attempt on it that is refined; None where the format refines none.
    """

    index: int
    task: str
    route: bool
    reflections: tuple[int, ...] = ()
    tracks: bool = False
    mirror: bool = False
    blur: bool = False
    pictures: bool = True
    camera: str | None = None
    camera_requested: bool = False
    attempt: int | None = None


class TaskSampler(BatchSampler):
    """Epochs of batches; a batch has one task, with or without route, so little is padded.

    Examples without pictures are always given their tracks: else there would be nothing to go by.

    Reflections are examples of their own beside all others: the natural mixture of CF-VLA section 6. They are
    learned behind the prompt that their plan was made from: behind another one, the plan gives itself away.
    Those on one scene share a prompt, and scenes with about as many share a batch. So are attempts, each with
    a long prompt of its own: a batch holds fewer of them. Feedback speaks of left and right and of the speeds
    that were, so they are neither mirrored nor blurred.

    Args:
        has_route: bool [m], which examples have one; so many there are.
        batch_size: responses per batch; with reflections, about so many.
        tasks: share of the examples for each task.
        route_share: share of the examples, among those that have one, that are given their route.
        tracks_share, mirror_share, blur_share: shares of the examples that are given their tracks, mirrored,
            and given no history but the present speed; see `Item`.
        pictured: bool [m], which examples have pictures; all by default.
        taught: bool [m], which examples have responses to be learned; all by default.
        mirror_reflected: whether reflections are mirrored too: those in phrases can be.
        next_cameras: of each example, the cameras whose picture half a second later can be taught; none
            without it.
        picture_share: share of the examples with such cameras that are taught a picture, of one of them;
            most of these are asked for it.
        seed: of the order; every epoch has another one.
        processes: so many batches in a row are alike, as those who share the work wait for the slowest.
        reflected: int64 [r], the example that each reflection is on.
        told: bool [r, 2], whether its prompt has the route, and the tracks; needed with reflections.
        reflecting: the format of reflections and of examples that are learned once more; needed with them.
        reasoning: whether reflections are learned; otherwise their examples are learned once more without,
            the control "multi-round" of CF-VLA section 4.3.
        attempted: int64 [a], the example that each attempt is on.
        attempting: the format that refines them; needed with them.
    """

    def __init__(
        self,
        has_route: npt.NDArray[np.bool_],
        batch_size: int,
        tasks: Mapping[str, float],
        route_share: float,
        seed: int,
        processes: int = 1,
        reflected: npt.NDArray[np.int64] = np.zeros(0, np.int64),
        reasoning: bool = True,
        *,
        reflecting: str | None = None,
        told: npt.NDArray[np.bool_] | None = None,
        tracks_share: float = 0.0,
        mirror_share: float = 0.0,
        blur_share: float = 0.0,
        pictured: npt.NDArray[np.bool_] | None = None,
        taught: npt.NDArray[np.bool_] | None = None,
        mirror_reflected: bool = False,
        next_cameras: Sequence[tuple[str, ...]] = (),
        picture_share: float = 0.0,
        attempted: npt.NDArray[np.int64] = np.zeros(0, np.int64),
        attempting: str | None = None,
    ) -> None:
        if len(attempted) and attempting is None:
            raise ValueError("attempts need a format that refines them")
        self._attempted, self._attempting = attempted, attempting or ""
        self._attempts_a_batch = max(1, batch_size // _PLAIN_AN_ATTEMPT)
        self._pictured = np.ones(len(has_route), np.bool_) if pictured is None else pictured
        self._taught = np.arange(len(has_route)) if taught is None else np.flatnonzero(taught)
        self._next_cameras, self._picture_share = next_cameras, picture_share
        self._mirror_reflected = mirror_reflected
        self._shares = {"tracks": tracks_share, "mirror": mirror_share, "blur": blur_share}
        self._processes, self._has_route, self._tasks = processes, has_route, tasks
        if len(reflected) and (reflecting is None or told is None):
            raise ValueError("reflections need a format that they are written in, and what was told")
        self._reflecting = reflecting or ""
        self._route_share, self._seed, self._epoch = route_share, seed, 0
        self._again = np.zeros(0, np.int64) if reasoning else reflected
        # Of an example, and whether route and tracks were told.
        self._reflections: dict[tuple[int, bool, bool], list[int]] = {}
        if reasoning and told is not None:
            for place, (index, (route, tracks)) in enumerate(zip(reflected, told, strict=True)):
                self._reflections.setdefault((int(index), bool(route), bool(tracks)), []).append(place)
        mean = len(reflected) / max(1, len(self._reflections))
        self._scenes_a_batch = max(1, round(batch_size / max(1.0, mean)))
        self._batch_size = batch_size
        # accelerate, sharding batches over processes, reads these three and sets the epoch of `sampler`. With
        # a number here it would leave out all batches of another length, which those of reflections have.
        self.batch_size, self.drop_last = None, True  # type: ignore[assignment]  # torch's stubs know no None
        self.sampler = cast("Sampler[int]", self)

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch's order."""
        self._epoch = epoch

    def __len__(self) -> int:
        kinds = (
            (np.concatenate([self._taught, self._again]), self._batch_size),
            (np.array([index for index, _, _ in self._reflections], np.int64), self._scenes_a_batch),
            (self._attempted, self._attempts_a_batch),
        )
        # Prompts with pictures and those without share no batch: each sort leaves a rest of its own.
        return sum(
            int((self._pictured[examples] == pictures).sum()) // size
            for examples, size in kinds
            for pictures in (False, True)
        )

    def __iter__(self) -> Iterator[list[Item]]:  # type: ignore[override]  # items instead of positions
        random = np.random.default_rng((self._seed, self._epoch))
        plain, plain_rest = self._rounds(self._plain(random), self._batch_size)
        reflected, reflected_rest = self._rounds(self._reflected(random), self._scenes_a_batch)
        tried, tried_rest = self._rounds(self._tries(random), self._attempts_a_batch)
        rounds = plain + reflected + tried
        for place in random.permutation(len(rounds)):
            yield from rounds[place]
        yield from plain_rest + reflected_rest + tried_rest

    def _plain(self, random: np.random.Generator) -> list[Item]:
        """The expert's own responses, in a new order; those on ``again`` with a plan."""
        count = len(self._taught)
        example = np.concatenate([self._taught, self._again])
        names = list(self._tasks)
        drawn = random.choice(len(names), len(example), p=list(self._tasks.values()))
        given = self._given(example, random)
        tracks, mirror, blur = (self._drawn(name, len(example), random) for name in _CHANCES)
        taught = self._next_pictures(example, random)
        return [
            Item(
                int(example[place]),
                names[drawn[place]] if place < count else self._reflecting,
                bool(given[place]),
                tracks=bool(tracks[place] or not self._pictured[example[place]]),
                mirror=bool(mirror[place]),
                blur=bool(blur[place]),
                pictures=bool(self._pictured[example[place]]),
                camera=taught[place][0],
                camera_requested=taught[place][1],
            )
            for place in random.permutation(len(example))
        ]

    def _reflected(self, random: np.random.Generator) -> list[Item]:
        prompts = list(self._reflections)
        mirror, blur = (self._drawn(name, len(prompts), random) for name in ("mirror", "blur"))
        mirror &= self._mirror_reflected
        return [
            Item(
                index,
                self._reflecting,
                route and bool(self._has_route[index]),
                tuple(self._reflections[prompts[place]]),
                tracks=tracks or not self._pictured[index],
                mirror=bool(mirror[place]),
                blur=bool(blur[place]),
                pictures=bool(self._pictured[index]),
            )
            for place in random.permutation(len(prompts))
            for index, route, tracks in [prompts[place]]
        ]

    def _tries(self, random: np.random.Generator) -> list[Item]:
        given = self._given(self._attempted, random)
        tracks = self._drawn("tracks", len(self._attempted), random)
        return [
            Item(
                index,
                self._attempting,
                bool(given[place]),
                tracks=bool(tracks[place] or not self._pictured[index]),
                pictures=bool(self._pictured[index]),
                attempt=int(place),
            )
            for place in random.permutation(len(self._attempted))
            for index in [int(self._attempted[place])]
        ]

    def _drawn(self, name: str, count: int, random: np.random.Generator) -> npt.NDArray[np.bool_]:
        share = self._shares[name]
        # No share, no draw: orders stay what they were before there were such shares.
        return random.random(count) < share if share else np.zeros(count, np.bool_)

    def _next_pictures(
        self, example: npt.NDArray[np.int64], random: np.random.Generator
    ) -> list[tuple[str | None, bool]]:
        """For each example the camera whose next picture is taught, if any, and whether it is asked for."""
        if not self._picture_share or not any(self._next_cameras):
            return [(None, False)] * len(example)  # no draw, as above
        chances = random.random((len(example), 3)).tolist()
        drawn: list[tuple[str | None, bool]] = []
        for index, (taught, which, asked) in zip(example.tolist(), chances, strict=True):
            cameras = self._next_cameras[index]
            if cameras and taught < self._picture_share:
                drawn.append((cameras[int(which * len(cameras))], asked < _ASKED_SHARE))
            else:
                drawn.append((None, False))
        return drawn

    def _given(self, example: npt.NDArray[np.int64], random: np.random.Generator) -> npt.NDArray[np.bool_]:
        chosen: npt.NDArray[np.bool_] = random.random(len(example)) < self._route_share
        return self._has_route[example] & chosen

    def _rounds(self, items: list[Item], size: int) -> tuple[list[list[list[Item]]], list[list[Item]]]:
        """Batches of like items, as many in a round as there are processes; and batches of the rest."""
        rounds: list[list[list[Item]]] = []
        buckets: dict[tuple[str, bool, bool, bool, int, bool], list[Item]] = {}
        for item in items:
            key = (
                item.task,
                item.route,
                item.tracks,
                item.pictures,
                len(item.reflections),
                item.camera is not None,
            )
            bucket = buckets.setdefault(key, [])
            bucket.append(item)
            if len(bucket) == size * self._processes:
                rounds.append(_split(buckets.pop(key), size))
        rest: list[list[Item]] = []
        # Prompts of any kind can share a batch, but not those with pictures and those without.
        for pictures in (False, True):
            left = [item for key in sorted(buckets) for item in buckets[key] if item.pictures == pictures]
            rest += _split(left, size)[: len(left) // size]
        return rounds, rest


def _split(items: list[Item], size: int) -> list[list[Item]]:
    return [items[start : start + size] for start in range(0, len(items), size)]
