"""What callers decide about decoding, and the plans that they give."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag

from looktwice.clients.wire.base import MAX_SEED, Camera, Finite, Probability, RequestModel, Temperature, TopP

Thinking = Literal["adaptive", "always", "never"]
Decision = Literal["least_error", "drawn"]
Reasons = Literal["in_view", "any"]
Imagine = Literal["auto", "never", "always"]


class Motion(RequestModel):
    """Where the ego will be in half a second, in its frame of now; farther than 40 m away is refused."""

    x_m: Finite = Field(description="Ahead.")
    y_m: Finite = Field(default=0.0, description="To the left.")
    heading_rad: Finite = Field(default=0.0, description="Counter-clockwise.")


class MetaAction(RequestModel):
    """One named intent over one time interval."""

    start_s: Finite = Field(description="Begin in s, on the 0.1 s grid.")
    end_s: Finite = Field(description="End in s, on the 0.1 s grid.")
    word: str = Field(max_length=40, description="e.g. Accelerate, Left Turn, Keep Lane.")


class Tracks(RequestModel):
    """The three tracks of a plan; each one that is there covers 0.0 s to 6.4 s without gap or overlap."""

    longitudinal: list[MetaAction] | None = Field(default=None, max_length=64)
    lateral: list[MetaAction] | None = Field(default=None, max_length=64)
    lane: list[MetaAction] | None = Field(default=None, max_length=64)


def _form_of_plan(value: object) -> str:
    return "text" if isinstance(value, str) else "tracks"


PlanGiven = Annotated[
    Annotated[str, Field(max_length=20_000), Tag("text")] | Annotated[Tracks, Tag("tracks")],
    Discriminator(_form_of_plan),
]
"""A plan as bullet text or as tracks; the discriminator keeps errors to the form that was meant."""


class ReflectControls(RequestModel):
    """What the caller decides about decoding behind a given plan."""

    thinking: Thinking = Field(
        default="adaptive",
        description="Who decides on a second look: the model, always think, never think. A model card's "
        "`thinking` says what a format takes.",
    )
    think_threshold: Probability | None = Field(
        default=None,
        description="With adaptive: think exactly when the think probability exceeds it; "
        "null samples the branch.",
    )
    n: int = Field(default=6, ge=1, le=64, description="Draws.")
    temperature: Temperature = 1.0
    top_p: TopP = 1.0
    seed: int = Field(
        default=0,
        ge=0,
        le=MAX_SEED,
        description="The same request and seed give the same draws; on a CPU to the last byte.",
    )
    deadline_ms: int | None = Field(
        default=None,
        ge=1,
        le=600_000,
        description="Milliseconds from the request's arrival until the answer must be there; null for none.",
    )
    numbers: Decision = Field(
        default="least_error",
        description="How numbers in the text, such as a plan's times, are chosen: least_error takes the one "
        "of least expected error, drawn draws them as words are.",
    )
    codes: Decision = Field(
        default="least_error",
        description="How trajectory codes and those of pictures are chosen, in the same two ways.",
    )
    bind: bool = Field(
        default=False,
        description="Begin only trajectories that do what the plan says, as our labeller reads them.",
    )
    reasons: Reasons = Field(
        default="in_view",
        description="What a reflection in phrases may state: only what the view gives a reason for, by the "
        "tracks or, without tracks, by what the model reads from the pictures; or anything.",
    )
    logprobs: bool = Field(
        default=False, description="Tell each draw's tokens, and how likely each of its decisions was."
    )


class Controls(ReflectControls):
    """What the caller decides about decoding."""

    prefill: PlanGiven | None = Field(
        default=None,
        description="The first plan, given instead of written by the model: bullet text, or tracks.",
    )
    imagine: Imagine = Field(
        default="auto",
        description="Who decides whether a picture half a second ahead is imagined: auto leaves it to the "
        "model. For formats that imagine, which GET /v1/models lists; refused by others.",
    )
    camera: Camera | None = Field(
        default=None,
        description="Whose picture is imagined, where one is; it need not be in the scene. null leaves it to "
        "the model.",
    )
    motion: Motion | None = Field(
        default=None,
        description="Where the ego will be when that picture is taken; needs a camera. null leaves it to the "
        "model.",
    )
    imagine_once: bool = Field(
        default=False,
        description="All draws share what stands up to the picture, and differ in what they do about it: one "
        "picture is written for all.",
    )
