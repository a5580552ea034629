"""What an example teaches: its prompt, and the responses that follow it, rendered for the network."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple, cast

import numpy as np
from torch.utils.data import Dataset

from looktwice.model.driving.mends import mended
from looktwice.model.driving.next_view import expected_view
from looktwice.model.driving.plan import Plan
from looktwice.model.driving.scene import mirrored_camera
from looktwice.model.driving.trajectory import (
    FUTURE_STEPS,
    HISTORY_STEPS,
    POSE_MIRROR,
    STEP_S,
    present_speed,
)
from looktwice.model.families.family import (
    Counterfactual,
    FamilyError,
    JudgedAttempt,
    Lesson,
    NextPicture,
    Situation,
)
from looktwice.model.families.registry import families_of
from looktwice.model.families.trajectory_codes import CODES
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.formats.pieces import FormatError
from looktwice.model.network.chat_prompt import motion_text
from looktwice.model.network.codec import TrajectoryCodec
from looktwice.model.network.inputs import InputBuilder
from looktwice.model.network.patches import patchify
from looktwice.model.network.second_sketch import LOOK_GAIN
from looktwice.model.network.visual_codes import Frame, VisualCodes, frame_of
from looktwice.model.network.vocabulary import Vocabulary
from looktwice.model.training.batches import Array, ResponseSample
from looktwice.model.training.examples import Examples, example_frames
from looktwice.model.training.own_plans import OwnPlans
from looktwice.model.training.reflections import mirrored
from looktwice.model.training.response_targets import SectionWeights, Target, make_target
from looktwice.model.training.sampler import Item
from looktwice.model.training.sketched_looks import driven_plan, reasoned_look, same_words
from looktwice.model.training.soft_codes import SoftCodes
from looktwice.model.training.vision_cache import VisionCache

_EXPERT_SHARE: Final = 0.5
"""Of the plans behind which sketches are learned, so many are the expert's, with the expert's trajectory."""


class _Taught(NamedTuple):
    """A plan, and the trajectory [d] that it leads to.

    ``copied`` says that the prompt tells this trajectory, ``branches`` that a response without a reflection
    is an example of acting at once.
    """

    plan: Plan
    vector: Array
    reflection: Counterfactual | None = None
    copied: bool = False
    branches: bool = True


class ResponseDataset(Dataset[ResponseSample]):
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
        sketched: plans and trajectories are those of the sketch in the prompt, and so are trajectories behind
            plans of the model's own that hold. Behind reflections they are the sketch's with its mend,
            and behind the expert's plan, of which then nothing is taught, the expert's. Where the prompt
            tells what else might be driven, second looks at the sketch lead there.
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
        reflections: Sequence[Counterfactual] = (),
        attempts: Sequence[JudgedAttempt] = (),
        attempting: str | None = None,
        own_plans: OwnPlans | None = None,
        sketched: bool = False,
        visual_codes: VisualCodes | None = None,
        seed: int = 0,
    ) -> None:
        self._attempts = attempts
        self._own_plans, self._sketched = own_plans, sketched
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

    def __getitem__(self, item: Item) -> ResponseSample:
        examples, index, pictures = self._examples, item.index, self._pictures and item.pictures
        history, future = examples.history[index], examples.future[index]
        route = np.nan_to_num(examples.route[index])
        tracks = examples.tracks_given(index, mirror=item.mirror, route=item.route)
        plan, thoughts = examples.plan(index), examples.thought(index)
        perceived = examples.perception(index)
        if item.mirror:
            history, future, route = history * POSE_MIRROR, future * POSE_MIRROR, route * POSE_MIRROR[:2]
            plan = plan.mirrored()
            thoughts = None if thoughts is None else thoughts.mirrored()
            perceived = None if perceived is None else perceived.mirrored()
        if item.blur:
            history = steady_history(present_speed(history))
        picture = None if item.camera is None else self._next_picture(index, item.camera, item.mirror)
        tried = None if item.attempt is None else self._attempts[item.attempt]
        taught = self._taught(item, history, future, route, plan)
        # What the prompt tells is copied code by code: its tokens are those of the nearest ones.
        stages = self._inputs.settings.sketch_tokens
        soft = [
            self._soft.draw(each.vector, self.random, nearest=stages if each.copied else 0) for each in taught
        ]
        camera = picture.camera if picture is not None and item.camera_requested else None
        attempt = None if tried is None else tried.attempt
        expected = self._expected_codes(item, camera, history) if camera is not None else None
        lessons = [
            Lesson(
                *(each.plan, tuple(drawn.codes.tolist()), future, each.reflection, thoughts, perceived),
                next_picture=picture,
                expected=expected,
                attempt=tried,
            )
            for each, drawn in zip(taught, soft, strict=True)
        ]
        situation = Situation(history, route if item.route else None, attempt, camera)
        return ResponseSample(
            prompt=self._prompt(item, situation),
            responses=[
                self._target(item.task, lesson, branches=each.branches)
                for lesson, each in zip(lessons, taught, strict=True)
            ],
            seen=self._vision.tokens(index, item.mirror) if pictures and self._vision is not None else None,
            patches=self._patches(item) if pictures and self._vision is None else None,
            history=history,
            route=route,
            tracks=tracks,
            future=future,
            code_shares=np.stack([drawn.shares for drawn in soft]),
            code_errors_m=np.stack([drawn.errors_m for drawn in soft]),
        )

    def _sketch(self, item: Item) -> Array | None:
        """The trajectory [d] that the prompt sketches, where it is to be learned."""
        if not self._sketched or self._own_plans is None or item.blur:
            return None
        return self._own_plans.sketch(item.index, mirror=item.mirror, route=item.route, tracks=item.tracks)

    def _taught(self, item: Item, history: Array, future: Array, route: Array, plan: Plan) -> list[_Taught]:
        """What is taught behind one prompt, whose plan is the expert's."""
        expert, sketch = self._codec.vectors(history[None], future[None])[0], self._sketch(item)
        if item.reflections:
            found = [self._reflections[place] for place in item.reflections]
            if item.mirror:
                found = [mirrored(each) for each in found]
            if sketch is None:
                return [_Taught(plan, expert, each) for each in found]
            return [
                _Taught(
                    *(each.revised_plan or plan, self._looked_at(each, sketch, history, future), each),
                    copied=each.mend is None,
                )
                for each in found
            ]
        at_once = _Taught(plan, expert)
        if sketch is not None:
            at_once = _Taught(driven_plan(self._codec, sketch, history, plan), sketch, copied=True)
        if self._own_plans is None or item.task != self.reflecting:
            return [at_once]
        seconds = self._own_plans.seconds(tracks=item.tracks)
        if sketch is not None and seconds is not None:
            second = seconds.find(item.index, mirror=item.mirror, route=item.route)
            given = route if item.route else None
            look = reasoned_look(self._codec, sketch, second, history, given, plan)
            if look is not None:
                at_once = at_once._replace(branches=not look.judged)
                return [at_once, _Taught(look.revised_plan or plan, second.vector, look, copied=True)]
            # Where words are the same for both, no second look can be right, and none is wrong.
            untold = second.gain >= LOOK_GAIN and same_words(self._codec, sketch, second, history, plan)
            at_once = at_once._replace(branches=not untold)
        # Nobody knows whether it deserves a second look: behind it the trajectory alone is taught.
        behind, led_to, copied = plan, expert, False
        if sketch is None or self.random.random() >= _EXPERT_SHARE:
            behind = self._own_plans.draw(
                item.index, self.random, mirror=item.mirror, route=item.route, tracks=item.tracks
            )
            led_to, copied = (expert, False) if sketch is None else (sketch, True)
        return [at_once, _Taught(plan, led_to, Counterfactual(behind, "", judged=False), copied)]

    def _looked_at(self, reflection: Counterfactual, sketch: Array, history: Array, future: Array) -> Array:
        """Where a plan that the sketch carries out leads behind a reflection: a trajectory [d]."""
        if reflection.mend is None:
            return sketch
        driven = self._codec.trajectories(history[None], sketch[None])[0]
        better = mended(reflection.mend, driven, future, history)
        vector: Array = self._codec.vectors(history[None], better[None])[0]
        return vector

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

    def _target(self, task: str, lesson: Lesson, *, branches: bool = True) -> Target:
        return make_target(
            self._families[task],
            self.formats[task],
            lesson,
            self._weights,
            expert_branches=self._expert_branches and branches,
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
