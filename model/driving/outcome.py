"""How a plan fares when it is followed: it holds, or fails, and at what."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal, cast

OUTCOMES_VERSION: Final = 1
"""Of `clients.metadrive.outcomes` and the car that follows; raised when plans may fare otherwise."""

FailureName = Literal["collision", "off_road", "off_route", "comfort", "behind", "ahead"]
HitKind = Literal["standing vehicle", "moving vehicle", "oncoming vehicle", "pedestrian", "obstacle"]


@dataclass(frozen=True)
class Outcome:
    """How a plan fared when it was followed for 6.4 s.

    Attributes:
        fails: at what, in the order collision, road, route, comfort, progress; empty where it holds.
        collided_s, hit: when it collided, and with what; None where it did not.
        off_road_s, off_route_s: when it first left the road, the lanes of its route; None where it did not.
        uncomfortable_s, uncomfortable: when the ride first broke a bound of comfort, and which; None where it
            did not, or collided before. Told even where the expert's own way breaks one, and then no failure.
        driven_m, expert_m: along the route, by this plan and by the expert from the same moment.
    """

    fails: tuple[FailureName, ...]
    collided_s: float | None
    hit: HitKind | None
    off_road_s: float | None
    off_route_s: float | None
    uncomfortable_s: float | None
    uncomfortable: str | None
    driven_m: float
    expert_m: float

    @property
    def holds(self) -> bool:
        """Whether nothing went wrong."""
        return not self.fails

    @property
    def rank(self) -> int:
        """2 where it holds; 0 where it hurts: it collides, or leaves the road or its route; 1 otherwise."""
        hurts = any(name in ("collision", "off_road", "off_route") for name in self.fails)
        return 0 if hurts else 1 + self.holds

    @property
    def behind_m(self) -> float:
        """How many metres less than the expert it drove along the route; below 0 where it drove more."""
        return self.expert_m - self.driven_m

    @property
    def progress(self) -> float:
        """Its share of the expert's way; 1 where the expert stands."""
        return self.driven_m / self.expert_m if self.expert_m > 0 else 1.0

    def to_json(self) -> dict[str, Any]:
        """As a record keeps it."""
        return asdict(self) | {"fails": list(self.fails)}

    @classmethod
    def from_json(cls, told: Mapping[str, Any]) -> Outcome:
        """Read what `to_json` told."""
        return cls(**{**told, "fails": cast("tuple[FailureName, ...]", tuple(told["fails"]))})
