"""Batches for learning to respond: prompts with one response or several, padded and stacked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, cast

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.utils.data import BatchSampler, Dataset, Sampler

from looktwice.model.driving.next_view import expected_view
from looktwice.model.driving.plan import Plan
from looktwice.model.driving.scene import mirrored_camera
from looktwice.model.driving.trajectory import FUTURE_STEPS, HISTORY_STEPS, STEP_S, present_speed
from looktwice.model.families.family import (
    FamilyError,
    JudgedAttempt,
    Lesson,
    NextPicture,
    Reflection,
    Situation,
)
from looktwice.model.families.registry import families_of
from looktwice.model.families.trajectory_codes import CODES
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.formats.pieces import FormatError
from looktwice.model.network.codec import TrajectoryCodec
from looktwice.model.network.inputs import InputBuilder
from looktwice.model.network.patches import patchify
from looktwice.model.network.prompts import motion_text
from looktwice.model.network.track_features import MIRRORED, without_route
from looktwice.model.network.visual_codes import Frame, VisualCodes, frame_of
from looktwice.model.network.vocabulary import Vocabulary
from looktwice.model.training.examples import Examples, example_frames
from looktwice.model.training.own_plans import OwnPlans
from looktwice.model.training.reflections import mirrored
from looktwice.model.training.soft_codes import SoftCodes
from looktwice.model.training.targets import SectionWeights, Target, make_target
from looktwice.model.training.vision_cache import VisionCache

Batch = dict[str, Tensor]

_PLAIN_AN_ATTEMPT: Final = 4
"""So many plain examples take as long, and as much memory, as one with a draft and five sections on it."""
_CHANCES: Final = ("tracks", "mirror", "blur")
_ASKED_SHARE: Final = 0.8
"""Of the pictures that are taught: the prompt asks for their camera, and shows what is expected of it. Others
are of the model's own choice."""
_MIRROR: Final = np.array([1, -1, 1, -1], np.float32)
"""Of poses (x, y, z, heading)."""

WIDTH_STEP: Final = 16
"""Batches are padded to multiples of this: few shapes, so kernels made for a shape are made few times and
kept in little memory (on CPUs every new shape costs megabytes)."""


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
        asked: whether the prompt asks for that camera.
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
    asked: bool = False
    attempt: int | None = None


Array = np.ndarray[tuple[int, ...], np.dtype[np.float32]]


@dataclass(frozen=True, eq=False)
class Sample:
    """One prompt and its responses, rendered for the network.

    Attributes:
        prompt: token ids.
        responses: their ids and weights.
        seen: float16 [v, hidden] vision tokens; None without pictures.
        patches: uint8 [p, n], where the tower learns too; else None.
        history, route, tracks, future: of the example, as its `Item` asks for them.
        code_shares, code_errors_m: [responses, stages, size], see `SoftTarget`.
    """

    prompt: list[int]
    responses: list[Target]
    seen: np.ndarray[tuple[int, ...], np.dtype[np.float16]] | None
    patches: np.ndarray[tuple[int, ...], np.dtype[np.uint8]] | None
    history: Array
    route: Array
    tracks: Array
    future: Array
    code_shares: Array
    code_errors_m: Array


class ResponseDataset(Dataset[Sample]):
    """Renders `Item`s; the items of an epoch come from `TaskSampler`.

    Attributes:
        formats: that the checkpoint writes, compiled.
        reflecting: the format of reflections, where the checkpoint writes any.
        random: draws codes and plans.

    Args:
        examples, codec, inputs, vocabulary: of the checkpoint.
        weights: of sections.
        pictures: whether prompts have them.
        vision: what the tower sees in all examples, where it does not learn; else their patches are given.
        reflections: to be asked for by items. Where some of those that are judged look twice and others do
            not, the expert's own responses teach nothing of the branch.
        attempts: to be asked for by items, which are refined in the format ``attempting``.
        own_plans: behind which trajectories are learned too, where nothing is reflected.
        visual_codes: of the checkpoint, where items are to teach pictures.
        seed: of the codes that are drawn.

    Raises:
        FormatError: a reflection holds text that the checkpoint cannot write.
        ValueError: there are reflections, and it writes none; an attempt holds text that the checkpoint
            cannot read or write.
    """

    def __init__(
        self,
        examples: Examples,
        codec: TrajectoryCodec,
        inputs: InputBuilder,
        vocabulary: Vocabulary,
        weights: SectionWeights,
        *,
        pictures: bool,
        vision: VisionCache | None = None,
        reflections: Sequence[Reflection] = (),
        attempts: Sequence[JudgedAttempt] = (),
        attempting: str | None = None,
        own_plans: OwnPlans | None = None,
        visual_codes: VisualCodes | None = None,
        seed: int = 0,
    ) -> None:
        self._attempts = attempts
        self._own_plans = own_plans
        self._visual_codes, self._next = visual_codes, dict[tuple[int, str, bool], NextPicture]()
        self._expected = dict[tuple[int, str, bool, bool], tuple[int, ...] | None]()
        self._examples, self._inputs, self._reflections = examples, inputs, reflections
        self._codec, self._vision = codec, vision
        self._soft = SoftCodes(codec, codec.vectors(examples.history, examples.future))
        self.random = np.random.default_rng(seed)
        self._weights, self._pictures, self._vocabulary = weights, pictures, vocabulary
        self._families = families_of(inputs.settings.formats, inputs.settings.reflection)
        self.formats = {
            name: CompiledFormat(family.format, vocabulary) for name, family in self._families.items()
        }
        # Both ways on from plans of the model's own: then these alone say when to look twice.
        judged = {bool(reflection.thinking) for reflection in reflections if reflection.judged}
        self._expert_branches = judged != {True, False}
        self.reflecting = next((name for name, family in self._families.items() if family.looks_twice), None)
        for reflection in reflections:
            if self.reflecting is None:
                raise ValueError(f"none of {', '.join(self._families)} reflects upon a plan")
            # Before hours of training: the format must be able to say it.
            plan = reflection.revised_plan or reflection.first_plan
            nowhere = np.zeros((FUTURE_STEPS, 4), np.float32)
            self._target(self.reflecting, Lesson(plan, (0,) * CODES, nowhere, reflection))
        for place, tried in enumerate(attempts if attempting is not None else ()):
            self._check(str(attempting), place, tried)

    def _check(self, task: str, place: int, tried: JudgedAttempt) -> None:
        """Raise ValueError unless an attempt can be told, and its answer taught where that is right."""
        try:
            self._inputs.text(task, Situation(self._examples.history[0], attempt=tried.attempt))
            if tried.correct:
                nowhere = np.zeros((FUTURE_STEPS, 4), np.float32)
                self._target(task, Lesson(Plan(), (0,) * CODES, nowhere, attempt=tried))
        except (FormatError, FamilyError) as error:
            raise ValueError(f"attempt {place} cannot be learned from in {task!r}: {error}") from error

    def __len__(self) -> int:
        return len(self._examples)

    def __getitem__(self, item: Item) -> Sample:
        examples, index, pictures = self._examples, item.index, self._pictures and item.pictures
        history, future = examples.history[index], examples.future[index]
        route, tracks = np.nan_to_num(examples.route[index]), examples.tracks[index]
        plan, thoughts = examples.plan(index), examples.thought(index)
        perceived = examples.perception(index)
        tracks = tracks.copy() if item.route else without_route(tracks)
        if item.mirror:
            history, future, route = history * _MIRROR, future * _MIRROR, route * _MIRROR[:2]
            tracks[:, MIRRORED] *= -1
            plan = plan.mirrored()
            thoughts = None if thoughts is None else thoughts.mirrored()
            perceived = None if perceived is None else perceived.mirrored()
        if item.blur:
            history = steady_history(present_speed(history))
        picture = None if item.camera is None else self._next_picture(index, item.camera, item.mirror)
        vector = self._codec.vectors(history[None], future[None])[0]
        found = [self._reflections[place] for place in item.reflections]
        if item.mirror:
            found = [mirrored(each) for each in found]
        reflections: list[Reflection | None] = [*found] or [None]
        if not found and self._own_plans is not None and item.task == self.reflecting:
            # Nobody knows whether it deserves a second look: nothing but the trajectory is taught behind it.
            own = self._own_plans.draw(
                index, self.random, mirror=item.mirror, route=item.route, tracks=item.tracks
            )
            reflections.append(Reflection(own, "", judged=False))
        tried = None if item.attempt is None else self._attempts[item.attempt]
        soft = [self._soft.draw(vector, self.random) for _ in reflections]
        lessons = [
            Lesson(plan, tuple(drawn.codes.tolist()), future, reflection, thoughts, perceived, picture, tried)
            for drawn, reflection in zip(soft, reflections, strict=True)
        ]
        camera = picture.camera if picture is not None and item.asked else None
        attempt = None if tried is None else tried.attempt
        expected = self._expected_codes(item, camera, history) if camera is not None else None
        situation = Situation(history, route if item.route else None, attempt, camera, expected)
        return Sample(
            prompt=self._prompt(item, situation),
            responses=[self._target(item.task, lesson) for lesson in lessons],
            seen=self._vision.tokens(index, item.mirror) if pictures and self._vision is not None else None,
            patches=self._patches(item) if pictures and self._vision is None else None,
            history=history,
            route=route,
            tracks=tracks,
            future=future,
            code_shares=np.stack([drawn.shares for drawn in soft]),
            code_errors_m=np.stack([drawn.errors_m for drawn in soft]),
        )

    def _next_picture(self, index: int, camera: str, mirror: bool) -> NextPicture:
        """What ``camera`` saw half a second later; its mirror image is that of the other side's camera."""
        key = (index, camera, mirror)
        if key not in self._next:
            frame = _frame(self._examples.next_picture(index, camera), mirror)
            self._next[key] = NextPicture(
                mirrored_camera(camera) if mirror else camera, self._codes_of(frame)
            )
        return self._next[key]

    def _expected_codes(self, item: Item, camera: str, history: Array) -> tuple[int, ...] | None:
        """What ``camera`` of the example, as it is or mirrored, would see then if only the ego moved."""
        key = (item.index, camera, item.mirror, item.blur)
        if key not in self._expected:
            shown = self._examples.now_picture(item.index, mirrored_camera(camera) if item.mirror else camera)
            self._expected[key] = (
                None
                if shown is None
                else self._codes_of(expected_view(_frame(shown, item.mirror), camera, history))
            )
        return self._expected[key]

    def _codes_of(self, frame: Frame) -> tuple[int, ...]:
        if self._visual_codes is None:
            raise ValueError("pictures are to be taught, and there are no codes to write them in")
        return tuple(self._visual_codes.encode(frame).tolist())

    def _target(self, task: str, lesson: Lesson) -> Target:
        return make_target(
            self._families[task],
            self.formats[task],
            lesson,
            self._weights,
            expert_branches=self._expert_branches,
        )

    def _prompt(self, item: Item, situation: Situation) -> list[int]:
        if self._pictures and item.pictures:
            prompt = self._inputs.prompt(item.task, situation, tracks=item.tracks)
            return cast("list[int]", prompt.ids.tolist())
        # Without pictures nothing but speed counts, and a trajectory's whole example has thirty tokens.
        motion = self._vocabulary.encode(
            motion_text(self._inputs.settings, route=item.route, tracks=item.tracks)
        )
        return [*motion, *self._inputs.text(item.task, situation)]

    def _patches(self, item: Item) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
        return patchify(
            example_frames(self._examples, item.index, item.mirror, self._inputs), self._inputs.settings
        )


def _frame(encoded: bytes, mirror: bool) -> Frame:
    """A picture in the size that codes paint, or its mirror image."""
    frame = frame_of(encoded)
    return np.ascontiguousarray(frame[:, ::-1]) if mirror else frame


def steady_history(speed_ms: float) -> Array:
    """The history float32 [16, 4] of an ego that came straight on at its present speed."""
    history = np.zeros((HISTORY_STEPS, 4), np.float32)
    history[:, 0] = speed_ms * STEP_S * np.arange(1 - HISTORY_STEPS, 1)
    return history


class TaskSampler(BatchSampler):
    """Epochs of batches; a batch has one task, with or without route, so little is padded.

    Examples without pictures are always given their tracks: else there would be nothing to go by.

    Reflections are examples of their own beside all others: the natural mixture of CF-VLA section 6. Those
    on one scene share its prompt, and scenes with about as many share a batch. So are attempts, each with a
    long prompt of its own: a batch holds fewer of them. Feedback speaks of left and right and of the speeds
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
            half of these are asked for it.
        seed: of the order; every epoch has another one.
        processes: so many batches in a row are alike, as those who share the work wait for the slowest.
        reflected: int64 [r], the example that each reflection is on.
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
        if len(reflected) and reflecting is None:
            raise ValueError("reflections need a format that they are written in")
        self._reflecting = reflecting or ""
        self._route_share, self._seed, self._epoch = route_share, seed, 0
        self._again = np.zeros(0, np.int64) if reasoning else reflected
        self._reflections: dict[int, list[int]] = {}
        for place, index in enumerate(reflected if reasoning else ()):
            self._reflections.setdefault(int(index), []).append(place)
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
        plain = len(self._taught) + len(self._again)
        return (
            plain // self._batch_size
            + len(self._reflections) // self._scenes_a_batch
            + len(self._attempted) // self._attempts_a_batch
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
                asked=taught[place][1],
            )
            for place in random.permutation(len(example))
        ]

    def _reflected(self, random: np.random.Generator) -> list[Item]:
        example = np.array(list(self._reflections), np.int64)
        given = self._given(example, random)
        tracks, mirror, blur = (self._drawn(name, len(example), random) for name in _CHANCES)
        mirror &= self._mirror_reflected
        return [
            Item(
                index,
                self._reflecting,
                bool(given[place]),
                tuple(self._reflections[index]),
                tracks=bool(tracks[place]),
                mirror=bool(mirror[place]),
                blur=bool(blur[place]),
                pictures=bool(self._pictured[index]),
            )
            for place in random.permutation(len(example))
            for index in [int(example[place])]
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


def collate(samples: list[Sample]) -> Batch:
    """Stack samples, padded on the right to a multiple of `WIDTH_STEP`.

    ``parts`` says what a token belongs to: 0 the prompt, k its k-th response, -1 padding.
    """
    longest = max(
        len(sample.prompt) + sum(len(response.ids) for response in sample.responses) for sample in samples
    )
    width = -(-longest // WIDTH_STEP) * WIDTH_STEP
    ids = np.zeros((len(samples), width), np.int64)
    weights = np.zeros((len(samples), width), np.float32)
    parts = np.full((len(samples), width), -1, np.int64)
    for row, sample in enumerate(samples):
        end = len(sample.prompt)
        ids[row, :end], parts[row, :end] = sample.prompt, 0
        for part, response in enumerate(sample.responses, start=1):
            place = slice(end, end + len(response.ids))
            ids[row, place], weights[row, place], parts[row, place] = response.ids, response.weights, part
            end = place.stop
    batch = {
        "input_ids": torch.from_numpy(ids),
        "parts": torch.from_numpy(parts),
        "loss_weights": torch.from_numpy(weights),
        "history": torch.from_numpy(np.stack([sample.history for sample in samples])),
        "route": torch.from_numpy(np.stack([sample.route for sample in samples])),
        "tracks": torch.from_numpy(np.stack([sample.tracks for sample in samples])),
        "futures": torch.from_numpy(np.stack([sample.future for sample in samples])),
        "code_shares": torch.from_numpy(np.concatenate([sample.code_shares for sample in samples])),
        "code_errors_m": torch.from_numpy(np.concatenate([sample.code_errors_m for sample in samples])),
    }
    if samples[0].seen is not None:
        batch["seen"] = torch.from_numpy(np.stack([np.asarray(sample.seen) for sample in samples]))
    if samples[0].patches is not None:
        batch["patches"] = torch.from_numpy(np.concatenate([sample.patches for sample in samples]))
    return batch
