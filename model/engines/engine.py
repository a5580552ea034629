"""The engine interface: submit a scene with controls, receive events per draw, cancel.

Controls are part of the request, not of the engine; every engine gives them the same meaning.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.next_view import Motion
from looktwice.model.driving.plan import Plan
from looktwice.model.driving.scene import CAMERAS, Scene
from looktwice.model.driving.trajectory import HALF_SECONDS_S, TEN_HZ_S, FloatArray, at_10_hz
from looktwice.model.families.family import Attempt, Foreseen, PictureRequest
from looktwice.model.families.family import Thinking as Thinking
from looktwice.model.formats.pieces import Plain, Value
from looktwice.model.network.model_card import ModelCard

Decision = Literal["least_error", "drawn"]
"""How numbers and codes are chosen."""
Reasons = Literal["in_view", "any"]
"""What a reflection in phrases may state."""
Imagine = Literal["auto", "never", "always"]
"""Who decides whether a picture is imagined: the model, or the caller."""
Cut = Literal["skipped", "shortened", "replaced"]
"""What a deadline did to a second look: not begun, ended early, given up for the draft."""

MAX_DRAWS = 64
"""Of one request."""


class EngineError(RuntimeError):
    """The engine failed; the request may be tried again."""

    @classmethod
    def because(cls, what: str, cause: Exception) -> EngineError:
        """An error that keeps its cause, to be handed on instead of raised."""
        error = cls(f"{what}: {cause}")
        error.__cause__ = cause
        return error


class RequestError(ValueError):
    """The request can never be served as it is; the text says what to change."""


@dataclass(frozen=True)
class Controls:
    """What the caller decides about decoding.

    Attributes:
        thinking: who decides at the branch: the model, always think, never think.
        think_threshold: with ``adaptive``: think exactly when the think probability exceeds it;
            None samples the branch like any other word.
        prefill: the first plan, given by the caller instead of written by the model.
        n: draws per scene.
        temperature: 0 takes the likeliest allowed token.
        top_p: nucleus mass, 1 keeps all allowed tokens.
        seed: random numbers depend on (seed, draw, position) only, so a draw is the same alone and in
            a batch.
        deadline_ms: milliseconds from submission by which the answer must be there; None for no deadline.
            Thinking that would not fit is not begun, or cut; while it lasts, a direct trajectory is made
            ready beside it and is the answer if the reflection does not end in time. A picture that the
            model might choose to imagine is not begun.
        numbers: how numbers in the text are chosen, such as the times of a plan: ``least_error`` takes the
            one that is expected to be off the least (`looktwice.model.engines.least_error`), ``drawn`` draws
            them as words are.
        codes: how trajectory codes and those of pictures are chosen, likewise.
        bind: only trajectories may be begun that do what the plan says (`looktwice.model.engines.binding`).
        reasons: what a reflection in phrases may state: only what has a reason ``in_view``, as far as the
            model can know, or ``any`` statement (`looktwice.model.engines.reason_mask`).
        logprobs: draws tell how likely each of their decisions was.
        imagine: who decides whether a picture is imagined: ``auto`` leaves it to the model. For formats that
            imagine.
        camera: whose picture is imagined, if one is; the prompt asks for it. None leaves it to the model.
        motion: where the ego will be when that picture is taken: forced, and asked for with the camera. None
            leaves it to the model.
        picture: the 98 codes of that picture, given by the caller instead of written by the model.
        imagine_once: all draws share what stands up to the picture: they see, foresee and imagine the same,
            and differ in what they do about it.
    """

    thinking: Thinking = "adaptive"
    think_threshold: float | None = None
    prefill: Plan | None = None
    n: int = 6
    temperature: float = 1.0
    top_p: float = 1.0
    seed: int = 0
    deadline_ms: int | None = None
    numbers: Decision = "least_error"
    codes: Decision = "least_error"
    bind: bool = False
    reasons: Reasons = "in_view"
    logprobs: bool = False
    imagine: Imagine = "auto"
    camera: str | None = None
    motion: Motion | None = None
    picture: tuple[int, ...] | None = None
    imagine_once: bool = False

    def __post_init__(self) -> None:
        if self.thinking not in ("adaptive", "always", "never"):
            raise RequestError(f"thinking must be adaptive, always or never, got {self.thinking!r}")
        for name, decision in (("numbers", self.numbers), ("codes", self.codes)):
            if decision not in ("least_error", "drawn"):
                raise RequestError(f"{name} must be least_error or drawn, got {decision!r}")
        if self.reasons not in ("in_view", "any"):
            raise RequestError(f"reasons must be in_view or any, got {self.reasons!r}")
        if self.imagine not in ("auto", "never", "always"):
            raise RequestError(f"imagine must be auto, never or always, got {self.imagine!r}")
        if self.camera is not None:
            if self.camera not in CAMERAS:
                raise RequestError(f"unknown camera {self.camera!r}; known are {', '.join(CAMERAS)}")
            if self.imagine == "never":
                raise RequestError("camera has no meaning with imagine: never")
        if self.imagine_once and self.imagine == "never":
            raise RequestError("imagine_once has no meaning with imagine: never")
        for name, given in (("motion", self.motion), ("picture", self.picture)):
            if given is not None and self.camera is None:
                raise RequestError(f"{name} has no meaning without the camera whose picture is imagined")
        if not isinstance(self.n, int) or not 1 <= self.n <= MAX_DRAWS:
            raise RequestError(f"n must be a whole number in 1..{MAX_DRAWS}, got {self.n}")
        if not 0.0 <= self.temperature <= 2.0:
            raise RequestError(f"temperature must lie in 0..2, got {self.temperature}")
        if not 0.0 < self.top_p <= 1.0:
            raise RequestError(f"top_p must lie in (0, 1], got {self.top_p}")
        if not isinstance(self.seed, int):
            raise RequestError(f"seed must be a whole number, got {self.seed}")
        if self.deadline_ms is not None and not self.deadline_ms >= 0:
            raise RequestError(f"deadline_ms must be 0 or more, got {self.deadline_ms}")
        if self.think_threshold is not None:
            if self.thinking != "adaptive":
                raise RequestError("think_threshold only has a meaning with thinking: adaptive")
            if not 0.0 <= self.think_threshold <= 1.0:
                raise RequestError(f"think_threshold must lie in 0..1, got {self.think_threshold}")

    @property
    def imagines(self) -> bool | None:
        """Whether these controls decide for a picture; None leaves it to the draw."""
        return None if self.imagine == "auto" else self.imagine == "always"

    @property
    def view(self) -> PictureRequest | None:
        """The picture that is asked for, if one is."""
        return None if self.camera is None else PictureRequest(self.camera, self.motion)

    def second_look(self, think_probability: float) -> bool | None:
        """Whether these controls decide for a second look; None leaves it to the draw."""
        if self.thinking != "adaptive":
            return self.thinking == "always"
        return None if self.think_threshold is None else think_probability > self.think_threshold


@dataclass(frozen=True)
class PlanRequest:
    """One scene to plan for.

    Attributes:
        request_id: unique among those that run.
        scene: what the car sees.
        format: a response format the checkpoint was trained on.
        controls: what the caller decides.
        attempt: to be refined; needed exactly where the format's family refines one.
        live: tell of free text and codes as they are written (`TextWritten`, `CodesWritten`), and what
            finished sections say.
    """

    request_id: str
    scene: Scene
    format: str
    controls: Controls = field(default_factory=Controls)
    attempt: Attempt | None = None
    live: bool = False


@dataclass(frozen=True, eq=False)
class Draw:
    """One finished response.

    Attributes:
        index: 0..n-1.
        text: the whole response as written.
        plan: the first plan; None where the format has none.
        branch: the option as the format writes it; None where the format has none.
        think_probability: probability of a second look at the branch, at temperature 1, over its options;
            None where the format has no branch.
        thinking: the reflection; None where the format or the branch has none.
        revised_plan: None likewise.
        trajectory: float32 [t, 4] in the ego frame.
        codes: the trajectory codes it was decoded from.
        tokens: tokens per section, forced ones included.
        passes: how often the network was run for it, its prompt apart.
        chosen: tokens at which the format left more than one; all others are forced.
        cut: what the deadline did to its second look; ``skipped`` also where there was no time for a picture.
            None where it did nothing.
        times_s: of the poses of the trajectory, its family's.
        ids: of its tokens.
        reasons: the statements that its reflection could make; None where it could make any.
        logprobs: of each token's choice, see `looktwice.model.engines.logprobs`; None where the token is
            forced. Empty where `Controls.logprobs` does not ask for them.
        section_logprobs: of each section's text, the sum over its choices; empty likewise.
        foreseen: what its family reads of it as perceived and foreseen; None where it tells of neither.
        sections: what the sections say that only its family has, see `Family.own_sections`.
        action: what it says that it does, in words of its family's `actions`; empty where that has none.
    """

    index: int
    text: str
    plan: Plan | None
    branch: str | None
    think_probability: float | None
    thinking: str | None
    revised_plan: Plan | None
    trajectory: FloatArray
    codes: tuple[int, ...]
    tokens: Mapping[str, int]
    passes: int = 0
    chosen: int = 0
    cut: Cut | None = None
    times_s: tuple[float, ...] = TEN_HZ_S
    ids: tuple[int, ...] = ()
    reasons: tuple[str, ...] | None = None
    logprobs: tuple[float | None, ...] = ()
    section_logprobs: Mapping[str, float] = field(default_factory=dict)
    foreseen: Foreseen | None = None
    sections: Mapping[str, list[Plain]] = field(default_factory=dict)
    action: tuple[str, ...] = ()

    @property
    def at_10_hz(self) -> FloatArray:
        """The trajectory at 10 Hz, up to its last pose or to 6.4 s: float32 [k, 4]."""
        return at_10_hz(self.trajectory, self.times_s)

    @property
    def scored(self) -> FloatArray:
        """The trajectory as NAVSIM's scores take it: as it is at 0.5 s, or at 10 Hz; float32 [8 or 64, 4]."""
        return self.trajectory if self.times_s == HALF_SECONDS_S else self.at_10_hz

    @property
    def looked_twice(self) -> bool:
        """Whether it took the branch that reflects."""
        return self.thinking is not None or self.revised_plan is not None


@dataclass(frozen=True)
class Started:
    """The request has left the queue: memory is reserved for all its draws."""


@dataclass(frozen=True)
class TextWritten:
    """A draw has written more of the free text of a section."""

    index: int
    section: str
    text: str


@dataclass(frozen=True)
class CodesWritten:
    """A draw has written so many of the codes of a section that it is within; at least one."""

    index: int
    section: str
    count: int


@dataclass(frozen=True)
class SectionFinished:
    """A draw has finished a section of its format.

    Attributes:
        index: of the draw.
        section: its name.
        text: as it is written.
        values: what it says; empty where the request is not live.
    """

    index: int
    section: str
    text: str
    values: tuple[Value, ...] = ()


@dataclass(frozen=True)
class DrawFinished:
    """A draw is complete."""

    draw: Draw


@dataclass(frozen=True)
class DraftFinished:
    """Under a deadline: a direct trajectory, kept in case the reflection of its draw does not end in time.

    A `DrawFinished` follows for the same index, with the reflection or, at the deadline, with this draft.
    """

    draw: Draw


Event = Started | TextWritten | CodesWritten | SectionFinished | DraftFinished | DrawFinished
"""What an engine tells while it answers a request."""


@dataclass(frozen=True)
class EngineLoad:
    """How full an engine is.

    Attributes:
        rows: draws that it has memory for.
        rows_used: draws that memory is reserved for.
        pictures_wait_s: how long the oldest scene whose pictures are not decoded has waited for that.
    """

    rows: int
    rows_used: int
    pictures_wait_s: float = 0.0


class Engine(Protocol):
    """Decodes responses for scenes. One event loop owns an engine; its methods are called from there."""

    @property
    def card(self) -> ModelCard:
        """What is loaded."""
        ...

    @property
    def load(self) -> EngineLoad:
        """How full it is now."""
        ...

    async def start(self) -> None:
        """Load and warm up; returns when the engine can plan. Raises `EngineError`.

        An engine that was stopped, or broke and was stopped, can be started again.
        """
        ...

    async def wait(self) -> None:
        """Wait until a started engine does not run any more; raises `EngineError` when it broke."""
        ...

    async def stop(self) -> None:
        """Cancel what is running and free everything."""
        ...

    async def load_weights(self, checkpoint: Path) -> None:
        """Go on with the weights, and the card, of another folder that is the same in all but its weights.

        Requests that were submitted before are answered with the old weights first. Those that are submitted
        meanwhile wait, and are answered as by a new engine over that folder: nothing is left that was made of
        the old weights.

        Raises:
            CheckpointError: the folder is no usable checkpoint, or differs in more than its weights, or this
                kind of engine takes none; it goes on as before.
            EngineError: the engine is not running, or broke over it.
        """
        ...

    def submit(self, request: PlanRequest) -> AsyncGenerator[Event]:
        """Queue a request and iterate over its events, `Started` first; ends after the n-th `DrawFinished`.

        Closing the iterator early cancels the request.

        Raises:
            RequestError: at the first iteration, when the request cannot be served.
            ImageError: at the first iteration, when a picture is damaged.
            EngineError: when decoding failed.
        """
        ...

    def prompt_tokens(self, request: PlanRequest) -> int:
        """Tokens of the prompt that a request is answered to, those of its pictures among them.

        ``request`` is one that was served.
        """
        ...

    def paint(self, request: PlanRequest, codes: Sequence[int]) -> npt.NDArray[np.uint8]:
        """An imagined picture, uint8 RGB [112, 224, 3]; takes ms of the caller's thread.

        Args:
            request: that it answers. Where it asks for a camera that its scene shows, what did not change is
                taken from there, if the checkpoint learned that.
            codes: 98 of the picture.

        Raises:
            RequestError: the checkpoint has no codes of pictures (`ModelCard.paints`).
        """
        ...

    def cancel(self, request_id: str) -> None:
        """Drop a request, whose iterator raises `EngineError`; unknown ids are ignored."""
        ...
