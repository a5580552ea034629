"""What a model family declares, so that everything else asks it and names none of its sections."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, NamedTuple, get_args

from looktwice.model.driving.mends import Mend
from looktwice.model.driving.next_view import Motion
from looktwice.model.driving.perceived import Perceived
from looktwice.model.driving.phrases import ReflectionLanguage
from looktwice.model.driving.plan import Plan
from looktwice.model.driving.scene import CAMERAS
from looktwice.model.driving.thoughts import Thoughts
from looktwice.model.driving.trajectory import TEN_HZ_S, FloatArray, GeometryError, check_times
from looktwice.model.families.prompts import Attempt as Attempt
from looktwice.model.families.prompts import PictureRequest as PictureRequest
from looktwice.model.families.prompts import Situation as Situation
from looktwice.model.families.prompts import TextInputs as TextInputs
from looktwice.model.formats.fixed import Decided, FixedValues, with_fixed
from looktwice.model.formats.pieces import (
    Format,
    FormatError,
    Plain,
    Section,
    Value,
    Values,
    choices,
    holds,
    plain,
    walk,
    with_picks,
)


class FamilyError(ValueError):
    """A family that is unknown, cannot be loaded, or does not fit its own format; the text says which."""


Thinking = Literal["adaptive", "always", "never"]
"""Who decides whether there is a second look: the model, or the caller."""


@dataclass(frozen=True)
class Branch:
    """The choice at which a response gives its trajectory or reflects first; controls may decide it.

    Attributes:
        name: of the choice, and of the section that it is in.
        direct: the option that leads to the trajectory at once: under a deadline, the draft.
        reflecting: the option that takes a second look.
    """

    name: str
    direct: str
    reflecting: str


@dataclass(frozen=True)
class Imagination:
    """The choice at which a response imagines a picture of a camera or does not; controls may decide it.

    Attributes:
        name: of the choice.
        imagined: its option that leads to a picture.
        unseen: its other option.
        camera: the name of the choice of the camera.
        cameras: how the format writes each of `CAMERAS`.
        section: that holds the picture's codes.
        perception: the section before it, of what is around.
        prediction: the section before it, of where the ego will be.
        perceived: what the values of the perception say. When somebody comes near may be written later: a
            perception alone does not tell.
        predicted: what the values of the prediction say.
        pictured: what the values of the picture say.
        predicting: the first values of the prediction, which say where the ego will be, of metres ahead and
            to the left.
        expecting: the first values of the picture, of the 98 codes that are expected and the 98 that are
            given; either may be None.
    """

    name: str
    imagined: str
    unseen: str
    camera: str
    cameras: Mapping[str, str]
    section: str
    perception: str
    prediction: str
    perceived: Callable[[tuple[Value, ...]], Perceived]
    predicted: Callable[[tuple[Value, ...]], Predicted]
    pictured: Callable[[tuple[Value, ...]], NextPicture]
    predicting: Callable[[float, float], tuple[Value, ...]]
    expecting: Callable[[tuple[int, ...] | None, tuple[int, ...] | None], tuple[Decided, ...]]

    @property
    def sections(self) -> frozenset[str]:
        """What stands up to the picture, and the picture; the choice has a section of its name."""
        return frozenset((self.perception, self.prediction, self.name, self.section))

    def fixed_values(
        self,
        expected: tuple[int, ...] | None,
        motion: Motion | None = None,
        picture: tuple[int, ...] | None = None,
    ) -> FixedValues:
        """What is decided beforehand.

        Args:
            expected: 98 codes of what the camera would see if only the ego moved; None where that is unknown.
            motion: where the ego will be; None where the model says that.
            picture: 98 codes of the picture; None where the model writes them.
        """
        found = {self.section: self.expecting(expected, picture)}
        return found if motion is None else found | {self.prediction: self.predicting(motion.x_m, motion.y_m)}

    def picks(self, imagines: bool | None, camera: str | None) -> dict[str, str]:
        """The options that are decided, by choice.

        Args:
            imagines: whether there is to be a picture; None where the model decides.
            camera: whose; None where the model decides.
        """
        picks = {} if imagines is None else {self.name: self.imagined if imagines else self.unseen}
        return picks if camera is None else picks | {self.camera: self.cameras[camera]}


@dataclass(frozen=True)
class Actions:
    """What responses say that they do, in few words that can be counted.

    Attributes:
        groups: the words of each group; an action is one of each.
        of: the action of a trajectory [64, 4] at 10 Hz.
    """

    groups: tuple[tuple[str, ...], ...]
    of: Callable[[FloatArray], tuple[str, ...]]


@dataclass(frozen=True)
class Corpus:
    """Text that a tokenizer learns from which is trained for a family, beside its prompts.

    Attributes:
        phrases: runs of text that it has a token for.
        responses: makes whole ones, where they need them of sentences about driving.
    """

    phrases: tuple[str, ...]
    responses: Callable[[Sequence[str]], Iterable[str]]


LessonPart = Literal["thoughts", "perceived"]
"""What annotations of a scene may tell, or not; see `Lesson`."""

Decode = Callable[[Sequence[int]], FloatArray]
"""Makes a trajectory float32 [64, 4] of codes, with the checkpoint's codec and the scene's history."""


@dataclass(frozen=True)
class NextPicture:
    """What a camera saw half a second later.

    Attributes:
        camera: one of `CAMERAS`.
        codes: 98 codes of its picture, see `looktwice.model.network.visual_codes`.

    Raises:
        FamilyError: there is no such camera.
    """

    camera: str
    codes: tuple[int, ...]

    def __post_init__(self) -> None:
        if self.camera not in CAMERAS:
            raise FamilyError(f"unknown camera {self.camera!r}; known are {', '.join(CAMERAS)}")


class Predicted(NamedTuple):
    """Where the ego will be in half a second.

    Attributes:
        x_m: ahead, in its frame of now.
        y_m: to the left.
        direction: where it turns: Left, Forward or Right.
    """

    x_m: float
    y_m: float
    direction: str


@dataclass(frozen=True)
class Foreseen:
    """What a response sees around it, and half a second ahead.

    Attributes:
        perceived: who is around, and where the road ends.
        x_m: where the ego will be in half a second, ahead, in its frame of now.
        y_m: to the left.
        direction: where it turns: Left, Forward or Right.
        picture: what a camera will see then; None where it imagines nothing.
    """

    perceived: Perceived
    x_m: float
    y_m: float
    direction: str
    picture: NextPicture | None


@dataclass(frozen=True, eq=False)
class Reading:
    """What a response says. What it does not say is None.

    Attributes:
        trajectory: float32 [t, 4] in the ego frame, at the family's times.
        codes: the trajectory codes that it was decoded from, if any.
        plan: the first one, or the one that the caller gave.
        branch: the option that was taken.
        revised_plan: what takes its place.
        foreseen: what is perceived and foreseen before that.
        action: what it says that it does, a word of each group of its family's `Actions`.
    """

    trajectory: FloatArray
    codes: tuple[int, ...] = ()
    plan: Plan | None = None
    branch: str | None = None
    revised_plan: Plan | None = None
    foreseen: Foreseen | None = None
    action: tuple[str, ...] = ()


@dataclass(frozen=True)
class Counterfactual:
    """A counterfactual example's own parts: a plan of the model's own, and why it is to be corrected.

    ``thinking`` is empty where it is not: such a plan is acted on. ``revised_plan`` is what the reasoning
    leads to, where that is not the expert's plan in all tracks, and ``mend`` leads there from the plan's
    trajectory. ``judged`` says whether it is known that the plan deserves a second look, or none; otherwise
    nothing is taught of the branch.
    """

    first_plan: Plan
    thinking: str
    revised_plan: Plan | None = None
    mend: Mend | None = None
    judged: bool = True


@dataclass(frozen=True, eq=False)
class JudgedAttempt:
    """An example of refinement: what a model answered, what feedback says of it, and whether it was right.

    Where it was right, the answer itself is taught once more behind the feedback. ``thinking`` is what led to
    it; empty where it is not known, and not needed where the answer is wrong.
    """

    attempt: Attempt
    thinking: str
    correct: bool


@dataclass(frozen=True, eq=False)
class Lesson:
    """What a labelled scene has to teach.

    Attributes:
        plan: the expert's.
        codes: the expert's trajectory codes.
        future: float32 [64, 4], the expert's trajectory at 10 Hz.
        reflection: on a plan of the model's own, if any.
        thoughts: that lead to what the expert does; None where the scene's annotations do not tell.
        perceived: what there is to perceive; None where they do not tell.
        next_picture: None where there is none.
        expected: 98 codes of what its camera would see if only the ego moved; None where that is not known.
        attempt: to be refined, for families that do.
    """

    plan: Plan
    codes: tuple[int, ...]
    future: FloatArray
    reflection: Counterfactual | None = None
    thoughts: Thoughts | None = None
    perceived: Perceived | None = None
    next_picture: NextPicture | None = None
    expected: tuple[int, ...] | None = None
    attempt: JudgedAttempt | None = None


@dataclass(frozen=True, eq=False)
class Family:
    """A model family. Sections that it does not write are None.

    Attributes:
        format: of its responses; requests and checkpoints name the family by the format's name.
        task: what its prompt asks for.
        inputs: what its prompt says of a scene beside pictures, history, route and tracks.
        trajectory: the section that holds the trajectory.
        read: what the values of a response say.
        times_s: of the poses of its trajectories, 64 at 10 Hz unless it says otherwise.
        first_plan: the section of the plan that it writes first, and that callers may give.
        branch: where it may take a second look, which is a reflection, a revised plan, or both.
        reflection: the section where it says what is wrong with its first plan, or thinks without one.
        reflection_text: the values of that section in words, None where they say nothing. Not needed where
            the section has one value, which is a text.
        revised_plan: the section of the plan that takes the first one's place.
        teach: the values of the response that a labelled scene teaches; None where nothing is trained.
        lesson_needs: parts of a `Lesson` that ``teach`` cannot do without; scenes whose annotations do not
            tell them are left out of training.
        title: what tables of measures call it; its name without one.
        about: what a model of this family does, for cards: "A model that …".
        dialects: other formats of the same name, for checkpoints whose reflections are written otherwise.
        refines: whether its prompts hold an `Attempt`, which every request then has to bring.
        imagination: where it may imagine a picture.
        unthought: what responses say whose thoughts the caller does not want, where the format has thoughts
            without a branch.
        actions: what its responses say that they do, where tables can count it.
        rewards: what a response is worth beside the expert's trajectory [64, 4] at 10 Hz, part by part from 0
            to 1; None where drivers' scores alone tell.
        corpus: what a tokenizer learns of it, where one is trained; None where its words are plain English.

    Raises:
        FamilyError: the format lacks a section, the branch or the imagination that is declared, times do not
            ascend, or a reflection of several values lacks a `reflection_text`.
    """

    format: Format
    task: str
    trajectory: str
    read: Callable[[Values, Decode], Reading]
    times_s: tuple[float, ...] = TEN_HZ_S
    inputs: TextInputs | None = None
    first_plan: str | None = None
    branch: Branch | None = None
    reflection: str | None = None
    reflection_text: Callable[[tuple[Value, ...]], str | None] | None = None
    revised_plan: str | None = None
    teach: Callable[[Lesson], Values] | None = None
    lesson_needs: tuple[LessonPart, ...] = ()
    title: str | None = None
    about: str = "gives a trajectory"
    dialects: Mapping[ReflectionLanguage, Format] = field(default_factory=dict)
    refines: bool = False
    imagination: Imagination | None = None
    unthought: FixedValues = field(default_factory=dict)
    actions: Actions | None = None
    rewards: Callable[[FloatArray, Reading], Mapping[str, float]] | None = None
    corpus: Corpus | None = None

    def __post_init__(self) -> None:
        imagination = self.imagination
        declared = (
            *(() if imagination is None else imagination.sections - {imagination.name}),
            *(self.trajectory, self.first_plan, self.reflection, self.revised_plan),
            None if self.branch is None else self.branch.name,
        )
        lacking = {section for section in declared if section is not None} - set(self.format.sections())
        if lacking:
            raise FamilyError(f"family {self.name!r}: its format has no section {min(lacking)!r}")
        try:
            check_times(self.times_s)
        except GeometryError as error:
            raise FamilyError(f"family {self.name!r}: {error}") from None
        if self.branch is not None:
            if self.reflection is None and self.revised_plan is None:
                raise FamilyError(f"family {self.name!r}: a second look writes a reflection or a plan")
            _check_branch(self.name, self.format, self.branch)
        if self.reflection is not None and self.reflection_text is None:
            for section in walk(self.format.body):
                if isinstance(section, Section) and section.name == self.reflection:
                    _check_one_value(self.name, section)
        if imagination is not None:
            self._check_imagination(imagination)
        try:
            with_fixed(self.format.body, self.unthought)
        except FormatError as error:
            raise FamilyError(f"family {self.name!r}: unthought: {error}") from None

    def _check_imagination(self, imagination: Imagination) -> None:
        try:
            for imagines in (True, False):
                with_picks(self.format.body, imagination.picks(imagines, None))
            for camera in CAMERAS:
                with_picks(self.format.body, imagination.picks(True, camera))
        except (FormatError, KeyError) as error:
            raise FamilyError(f"family {self.name!r}: imagination: {error}") from None

    @property
    def name(self) -> str:
        """As requests give it."""
        return self.format.name

    @cached_property
    def plans(self) -> tuple[str, ...]:
        """The sections of plans, the one that counts first where several are written."""
        return tuple(each for each in (self.revised_plan, self.first_plan) if each is not None)

    @cached_property
    def own_sections(self) -> frozenset[str]:
        """The sections that hold neither a plan, the branch, the reflection nor the trajectory."""
        branch = None if self.branch is None else self.branch.name
        known = {self.first_plan, branch, self.reflection, self.revised_plan, self.trajectory}
        return frozenset(self.format.sections()) - known

    def own(self, values: Values) -> dict[str, list[Plain]]:
        """What a response says in its own sections, in the order of the format."""
        return {
            name: [plain(each) for each in values.all(name)] for name in values if name in self.own_sections
        }

    def reflected(self, values: Values) -> str | None:
        """What a response says in its reflection, in words; None where it has none, or says nothing."""
        said = () if self.reflection is None else values.all(self.reflection)
        if not said:
            return None
        return str(said[0]) if self.reflection_text is None else self.reflection_text(said)

    @property
    def looks_twice(self) -> bool:
        """Whether it reflects upon a plan of its own, as counterfactual examples teach."""
        return self.first_plan is not None and self.reflection is not None

    @cached_property
    def thinking_choices(self) -> tuple[Thinking, ...]:
        """What callers may ask of its thoughts; a think threshold takes a branch, as ``always`` does."""
        if self.branch is not None:
            return get_args(Thinking)
        without = self.unthought or self.reflection is None
        return ("adaptive", "never") if without else ("adaptive",)

    def thinking_refused(self, thinking: Thinking) -> str | None:
        """Why responses cannot be asked to think so; None where they can."""
        if thinking in self.thinking_choices:
            return None
        known = " or ".join(self.thinking_choices)
        return f"responses in {self.name} cannot be asked for {thinking}; ask for {known}"

    @property
    def bare(self) -> bool:
        """Whether its responses are a trajectory and nothing else."""
        return self.format.sections() == (self.trajectory,)

    def in_dialect(self, reflection: ReflectionLanguage) -> Family:
        """The family of a checkpoint whose reflections are so written."""
        return replace(self, format=self.dialects.get(reflection, self.format))


def _check_one_value(family: str, section: Section) -> None:
    count = holds(section.body)
    if count != 1:
        held = "several values" if count is None else f"{count} values"
        raise FamilyError(
            f"family {family!r}: section {section.name!r} holds {held}; say by reflection_text how they read"
        )


def _check_branch(family: str, format: Format, branch: Branch) -> None:
    found = [choice for choice in choices(format.body) if choice.name == branch.name]
    if len(found) != 1:
        raise FamilyError(f"family {family!r}: its format has {len(found)} choices {branch.name!r}, not one")
    texts = [option.text for option in found[0].options]
    if lacking := {branch.direct, branch.reflecting} - set(texts):
        raise FamilyError(f"family {family!r}: choice {branch.name!r} has no option {min(lacking)!r}")
    if len({text[:1] for text in texts}) < len(texts):
        # Controls decide with the first token.
        raise FamilyError(f"family {family!r}: the options of {branch.name!r} must begin differently")
