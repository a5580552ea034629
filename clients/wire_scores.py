"""The contract of POST /v1/score: labels and trajectories in, NAVSIM's sub-scores out.

One frame for everything in a request: that of the ego now, at the point that its poses are of (the rear axle
or the middle of its box), x forward, y left, metres, headings in radians counter-clockwise.
"""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import FailFast, Field, SkipValidation, model_validator

from looktwice.clients.wire import Length, Nearby, NearbyPoint, Problem, RequestModel, ResponseModel

MAX_TRAJECTORIES: Final = 4096
MAX_SCORED_TOGETHER: Final = 64
"""Scenes of one batch."""

ScoreVersion = Literal["v1.1", "v2.2"]
ReferencePoint = Literal["rear_axle", "centre"]
ScorePose = Annotated[
    list[Nearby], Field(min_length=3, max_length=3, description="x, y in m, heading in rad")
]
ScoreTrajectory = Annotated[
    list[ScorePose],
    Field(min_length=8, max_length=64, description="8 poses at 0.5 s, or 64 at 0.1 s; the first is not now."),
]
Ring = Annotated[
    list[NearbyPoint],
    # Of long lists the first fault alone is told: a body may hold hundreds of thousands.
    Field(min_length=3, max_length=400, fail_fast=True, description="An outline that does not cross itself."),
]
Name = Annotated[str, Field(min_length=1, max_length=100)]


class VehicleShape(RequestModel):
    """The ego's body, from its rear axle; NAVSIM's car where none is given."""

    width_m: Length = 2.297
    front_m: Length = Field(default=4.049, description="From the rear axle to the front bumper.")
    rear_m: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = Field(
        default=1.127, description="From the rear axle to the rear bumper."
    )
    wheelbase_m: Length = 3.089


class EgoMotion(RequestModel):
    """How the ego moves now; it stands at (0, 0, 0)."""

    speed_mps: Annotated[float, Field(ge=-60, le=100, allow_inf_nan=False)]
    acceleration_mps2: Annotated[float, Field(ge=-30, le=30, allow_inf_nan=False)] = 0.0
    steering_rad: Annotated[float, Field(ge=-1, le=1, allow_inf_nan=False)] = Field(
        default=0.0, description="Of the front wheels."
    )
    yaw_rate_rad_s: Annotated[float, Field(ge=-5, le=5, allow_inf_nan=False)] = 0.0
    yaw_acceleration_rad_s2: Annotated[float, Field(ge=-50, le=50, allow_inf_nan=False)] = 0.0


class PastMotion(RequestModel):
    """The ego at one moment before now."""

    heading_rad: Annotated[float, Field(ge=-100, le=100, allow_inf_nan=False)]
    acceleration_mps2: Annotated[float, Field(ge=-30, le=30, allow_inf_nan=False)]
    lateral_acceleration_mps2: Annotated[float, Field(ge=-30, le=30, allow_inf_nan=False)] = 0.0


class ScoredAgent(RequestModel):
    """Something that the ego could hit, now and in the future."""

    agent_id: Name
    kind: Literal["vehicle", "bicycle", "pedestrian", "static"] = Field(
        description="static for cones, barriers and the like, which weigh less."
    )
    length_m: Length
    width_m: Length
    poses: list[Annotated[list[Nearby], Field(min_length=3, max_length=3)] | None] = Field(
        fail_fast=True,
        min_length=41,
        max_length=51,
        description="Centre and heading at 10 Hz, the first row is now; null where it is not there. "
        "v2.2 needs 41 rows, v1.1 50.",
    )
    speed_mps: Annotated[float, Field(ge=0, le=200, allow_inf_nan=False)] | None = Field(
        default=None, description="When it is first there; by default that of its first two poses."
    )


class ScoredLane(RequestModel):
    """A lane, or a lane's way over an intersection."""

    lane_id: Name
    ring: Ring
    on_route: bool = Field(description="Whether the ego may go along it; elsewhere it is oncoming traffic.")


class ClosedLane(RequestModel):
    """A lane behind a red light."""

    light_id: Name
    ring: Ring
    from_s: Annotated[float, Field(ge=0, le=4, allow_inf_nan=False)] = 0.0
    until_s: Annotated[float, Field(ge=0, le=4, allow_inf_nan=False)] = 4.0


class Labels(RequestModel):
    """What is known of a moment and its next seconds.

    A layer that is null is not known, and what needs it is not scored. An empty list says that there is none.
    """

    ego: EgoMotion
    past: list[PastMotion] | None = Field(
        default=None,
        min_length=2,
        max_length=50,
        description="Before now at 10 Hz, oldest first, the last one 0.1 s ago; NAVSIM has 15 of them.",
    )
    agents: list[ScoredAgent] | None = Field(default=None, max_length=300, fail_fast=True)
    lanes: list[ScoredLane] | None = Field(default=None, max_length=300, fail_fast=True)
    intersections: list[Ring] | None = Field(default=None, max_length=100, fail_fast=True)
    drivable: list[Annotated[list[Ring], Field(min_length=1, max_length=50)]] | None = Field(
        default=None,
        max_length=200,
        fail_fast=True,
        description="Areas where a car may be, besides intersections; the first ring of each is its outline, "
        "others are holes.",
    )
    red_lights: list[ClosedLane] | None = Field(default=None, max_length=100, fail_fast=True)
    centreline: Annotated[list[NearbyPoint], Field(min_length=2, max_length=2000)] | None = Field(
        default=None, fail_fast=True, description="The middle of the lanes that the reference follows."
    )


class PreviousPlan(RequestModel):
    """A plan made shortly before, for extended comfort; poses in the ego's frame of then."""

    trajectory: ScoreTrajectory
    ego: EgoMotion
    seconds_ago: Annotated[float, Field(ge=0.1, lt=0.55, allow_inf_nan=False)] = 0.5


class ScoreRequest(RequestModel):
    """Body of POST /v1/score."""

    labels: Labels | None = Field(default=None, description="Or scene_id.")
    scene_id: str | None = Field(
        default=None,
        max_length=200,
        description="A bundled scene instead of labels: its own vehicle, poses of the box's centre, and its "
        "expert as the reference where none is given.",
    )
    # Of thousands of wrong ones the first is told: all the faults would take a second to gather.
    trajectories: Annotated[list[ScoreTrajectory], FailFast()] = Field(
        min_length=1,
        max_length=MAX_TRAJECTORIES,
        description="All of one length. A body may hold 250,000 values: 4,096 of 8 poses or 1,000 of 64.",
    )
    version: ScoreVersion = Field(default="v2.2", description="v1.1 is PDMS, v2.2 is EPDMS.")
    point: ReferencePoint = Field(
        default="rear_axle", description="What poses are of. With scene_id it is the centre in any case."
    )
    vehicle: VehicleShape = VehicleShape()
    reference: ScoreTrajectory | None = Field(
        default=None, description="What progress is measured against; NAVSIM takes PDM-Closed's plan."
    )
    against: Name = Field(default="reference", description="What the reference is, for the answer.")
    previous: PreviousPlan | None = None
    human: ScoreTrajectory | None = Field(
        default=None, description="What the human fails at too, plans are forgiven; v2.2 only."
    )

    @model_validator(mode="after")
    def _one_world(self) -> ScoreRequest:
        if (self.labels is None) == (self.scene_id is None):
            raise ValueError("give either labels or scene_id")
        return self


class ScoreBatchRequest(RequestModel):
    """Body of POST /v1/score/batch."""

    # Each is checked by itself, so that one that breaks the contract fails alone.
    requests: list[SkipValidation[ScoreRequest]] = Field(min_length=1, max_length=MAX_SCORED_TOGETHER)


class ScoreFailure(ResponseModel):
    """One sub-score at which a plan fails."""

    sub_score: str
    time_s: float = Field(description="When it fails first.")
    other_id: str | None = Field(description="The agent or the light with which; null where there is none.")
    distance_m: float | None = Field(
        description="Between the boxes then; of the farthest corner off the road; of the centre from the "
        "centre line; driven against the traffic within a second. Null where it says nothing."
    )
    what: str = Field(description="Of comfort, the bound that is broken; empty otherwise.")


class TrajectoryScore(ResponseModel):
    """What one trajectory is worth."""

    score: float | None = Field(description="0 to 1; null where a sub-score that counts is missing.")
    partial_score: float | None = Field(description="Of those sub-scores that are there.")
    sub_scores: dict[str, float | None] = Field(
        description="By name; null where what would decide it is not known."
    )
    progress_m: float | None = Field(description="Along the centre line; null without one.")
    failures: list[ScoreFailure] = Field(description="In the order of time.")


class ScoreResponse(ResponseModel):
    """Answer of POST /v1/score."""

    request_id: str
    version: ScoreVersion
    missing: list[str] = Field(
        description="Sub-scores that count and are null for every trajectory: then there is no score, only "
        "a partial one."
    )
    against: str | None = Field(description="What progress was measured against; null where it was not.")
    scores: list[TrajectoryScore]


class ScoreResult(ResponseModel):
    """One scene of a batch."""

    status: int
    response: ScoreResponse | None = None
    problem: Problem | None = None


class ScoreBatchResponse(ResponseModel):
    """Answer of POST /v1/score/batch."""

    results: list[ScoreResult]
