"""How a plan fares when it is followed: it holds, or fails, and at what."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal, cast, get_args

OUTCOMES_VERSION: Final = 1
"""Of `looktwice.clients.metadrive.outcomes` and the car that follows; raised when plans may fare
otherwise."""

FailureName = Literal["collision", "off_road", "off_route", "comfort", "behind", "ahead"]
Verdict = FailureName | Literal["holds"]
VERDICTS: Final[tuple[Verdict, ...]] = ("holds", *get_args(FailureName))
"""What comes of a trajectory in a word: it holds, or at what it fails first."""
BEHIND_RATIO: Final = 0.8
"""Whoever drives less than this share of the expert's way falls behind ..."""
AHEAD_RATIO: Final = 1.25
"""... and whoever drives more than this share of it goes too far ..."""
LEAST_GAP_M: Final = 5.0
"""... if at least so many metres are between them, as in NAVSIM's progress."""
OFF_ROUTE_M: Final = 2.75
"""A car whose centre is farther from the middle of every lane of its route has left the route: a metre beyond
the edge of a lane of 3.5 m, in the lane of those who come towards it or in a road that is not its own."""
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
    def verdict(self) -> Verdict:
        """See `VERDICTS`."""
        return self.fails[0] if self.fails else "holds"

    @property
    def rank(self) -> int:
        """2 where it holds; 0 where it hurts: it collides, or leaves the road or its route; 1 otherwise."""
        hurts = any(name in ("collision", "off_road", "off_route") for name in self.fails)
        return 0 if hurts else 1 + self.holds

    @property
    def behind_m(self) -> float:
        """See `metres_behind`."""
        return metres_behind(self.driven_m, self.expert_m)

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


def metres_behind(driven_m: float, expert_m: float) -> float:
    """How many metres less than the expert somebody drove along the route; below 0 where it was more.

    Where the expert backs out from an obstacle, whoever stands still or backs out no farther is neither
    behind nor ahead.
    """
    if driven_m < expert_m:
        return expert_m - driven_m
    return min(max(expert_m, 0.0) - driven_m, 0.0)


def failures(
    *, collided: bool, off_road: bool, off_route: bool, rough: bool, driven_m: float, expert_m: float
) -> tuple[FailureName, ...]:
    """At what a plan fails that was followed; empty where it holds.

    Args:
        collided: whether it ended in a collision.
        off_road, off_route: whether it left the road, or the lanes of its route.
        rough: whether it broke a bound of comfort that the expert's own way keeps.
        driven_m, expert_m: along the route, by this plan and by the expert from the same moment.
    """
    behind_m = metres_behind(driven_m, expert_m)
    found: dict[FailureName, bool] = {
        "collision": collided,
        "off_road": off_road,
        "off_route": off_route,
        "comfort": rough and not collided,
        # A drive that a collision ended is shorter for that reason alone.
        "behind": not collided and behind_m > LEAST_GAP_M and driven_m < BEHIND_RATIO * expert_m,
        "ahead": not collided and -behind_m > LEAST_GAP_M and driven_m > AHEAD_RATIO * expert_m,
    }
    return tuple(name for name, failed in found.items() if failed)


def in_words(outcome: Outcome) -> str:
    """What a failing plan comes to, such as ``collides with an obstacle after 2.1 s``; "" where it holds."""
    return ", ".join(_told(name, outcome) for name in outcome.fails)


def _told(name: FailureName, outcome: Outcome) -> str:
    match name:
        case "collision":
            hit = outcome.hit or "obstacle"
            return (
                f"collides with {'an' if hit[0] in 'aeiou' else 'a'} {hit} after {outcome.collided_s:.1f} s"
            )
        case "off_road":
            return f"leaves the road after {outcome.off_road_s:.1f} s"
        case "off_route":
            return f"leaves the lanes of its route after {outcome.off_route_s:.1f} s"
        case "comfort":
            bound = (outcome.uncomfortable or "").replace("_", " ")
            return f"has too much {bound} after {outcome.uncomfortable_s:.1f} s"
        case "behind":
            return f"falls behind by {outcome.behind_m:.0f} m"
        case "ahead":
            return f"goes {-outcome.behind_m:.0f} m too far"
