"""One run: a load, run by workers against a service, and its figures by phase."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from looktwice.loadtests.accounting import Summary, faults, summarise
from looktwice.loadtests.exchange import Exchange
from looktwice.loadtests.loads import Load, LoadPhase, Window, WorkerPool, windows
from looktwice.loadtests.mix import Mix
from looktwice.loadtests.sending import ServiceTarget
from looktwice.model.driving.scene import LabelledScene

WARM_UP = "warm-up"


@dataclass(frozen=True)
class Setup:
    """What all scenarios are told.

    Attributes:
        target: where requests go.
        scenes: that are sent, pictures changed so that none occurs twice.
        mix: what is asked.
        rate_rps: requests offered per second.
        seconds: of the measured run, or of each of its steps.
        warm_up_s: offered before at the same rate, and left out of all figures.
        goal_s: the latency wanted of requests without a deadline of their own.
        lag_limit_s: a run whose requests were sent later (1 in 100) is not valid.
        seed: of arrivals, mix, pictures and draws.
        workers: processes that send.
        distinct: requests that are made; longer runs send them again.
        tell: told what is being done.
    """

    target: ServiceTarget
    scenes: Sequence[LabelledScene] = field(repr=False)
    mix: Mix
    rate_rps: float
    seconds: float
    warm_up_s: float
    goal_s: float
    lag_limit_s: float
    seed: int
    workers: int
    distinct: int
    tell: Callable[[str], None] = field(repr=False)

    def to_json(self) -> dict[str, Any]:
        """So that the run can be repeated."""
        mix = self.mix
        return {
            "rate_rps": self.rate_rps,
            "seconds": self.seconds,
            "warm_up_s": self.warm_up_s,
            "goal_s": self.goal_s,
            "lag_limit_s": self.lag_limit_s,
            "seed": self.seed,
            "workers": self.workers,
            "distinct": self.distinct,
            "mix": {
                "works": mix.works,
                "draws": {str(n): weight for n, weight in mix.draws.items()},
                "payloads": mix.payloads,
                "deadlines_ms": {
                    "none" if ms is None else str(ms): weight for ms, weight in mix.deadlines_ms.items()
                },
                "stream": mix.stream,
            },
        }


@dataclass(frozen=True)
class Result:
    """What a run found.

    Attributes:
        scenario: its name.
        overall: the figures that stand for the whole.
        phases: those of its parts, by name.
        faults: why it does not count; empty when it does.
        extra: figures of this scenario alone, for scripts.
        findings: the same in words, a line each.
        exchanges: all of them, the warm-up's included.
    """

    scenario: str
    overall: Summary
    phases: dict[str, Summary]
    faults: tuple[str, ...]
    extra: dict[str, Any] = field(default_factory=dict)
    findings: tuple[str, ...] = ()
    exchanges: tuple[Exchange, ...] = field(default=(), repr=False)

    @property
    def valid(self) -> bool:
        """Whether the figures are those of the load that was asked for."""
        return not self.faults


@dataclass(frozen=True)
class Ran:
    """Exchanges of one run, and where its phases lay."""

    exchanges: tuple[Exchange, ...]
    windows: dict[str, Window]
    starts_at: float

    def summary(self, goal_s: float, *names: str) -> Summary:
        """Figures from the beginning of the first named phase to the end of the last one."""
        first, last = self.windows[names[0]], self.windows[names[-1]]
        whole = Window(" to ".join(dict.fromkeys((first.name, last.name))), first.start_s, last.end_s)
        return summarise(self.exchanges, whole, goal_s)


def run(
    load: Load,
    phases: Sequence[LoadPhase],
    setup: Setup,
    meanwhile: Callable[[float], None] | None = None,
) -> Ran:
    """Run ``load`` to its end; ``meanwhile`` is called with the run's start, in `time.monotonic`'s seconds.

    Raises:
        WorkerDied: a process of the generator did.
    """
    with WorkerPool(load, setup.target, setup.workers) as crew:
        starts_at = crew.begin()
        if meanwhile is not None:
            meanwhile(starts_at)
        exchanges = crew.finish()
    return Ran(tuple(exchanges), {window.name: window for window in windows(phases)}, starts_at)


def check(summary: Summary, setup: Setup) -> list[str]:
    """See `looktwice.loadtests.accounting.faults`."""
    return faults(summary, setup.lag_limit_s)


def needed(phases: Sequence[LoadPhase], setup: Setup) -> int:
    """How many distinct calls a run is given."""
    return max(
        1, min(setup.distinct, round(sum(phase.seconds * phase.rate_rps for phase in phases) * 1.1) + 1)
    )
