"""Everything the service counts for Prometheus."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

from model.driving.plan import plan_iou
from model.engines.engine import Draw, ModelCard, Thinking

LATENCY_BUCKETS_S: Final = (
    *(0.025, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.5, 0.75),
    *(1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0, 60.0),
)
"""Planners ask for tens of milliseconds; small CPUs take seconds."""
TOKEN_BUCKETS: Final = (1, 2, 5, 10, 20, 40, 60, 80, 100, 150, 200, 300, 500)
PROBABILITY_BUCKETS: Final = tuple(step / 10 for step in range(1, 11))

BRANCH_LABELS: Final = {"Action:": "direct", "Thinking:": "think", None: "none"}


class Metrics:
    """The service's metrics in one registry; names start with ``looktwice_``.

    The think rate is ``looktwice_branches_total{branch="think"}`` over all branches; where a caller forced
    it, ``thinking`` is not ``adaptive``.
    """

    def __init__(self, registry: CollectorRegistry) -> None:
        self.registry = registry
        self._requests = Counter(
            "looktwice_requests",
            "Requests answered; status 499 is a caller that left.",
            ["endpoint", "method", "status"],
            registry=registry,
        )
        self._latency = Histogram(
            "looktwice_request_seconds",
            "From a request's headers to the end of its answer.",
            ["endpoint"],
            buckets=LATENCY_BUCKETS_S,
            registry=registry,
        )
        self.plans_in_flight = Gauge(
            "looktwice_plans_in_flight", "Scenes the engine is planning for.", registry=registry
        )
        self.ready = Gauge("looktwice_ready", "1 once the engine has warmed up.", registry=registry)
        self._model = Gauge(
            "looktwice_model_info", "What is loaded.", ["name", "revision", "engine"], registry=registry
        )
        self._tokens = Histogram(
            "looktwice_section_tokens",
            "Tokens of a section in one draw.",
            ["section"],
            buckets=TOKEN_BUCKETS,
            registry=registry,
        )
        self._branches = Counter(
            "looktwice_branches",
            "Draws by the branch they took, by who decided, and by what was asked for.",
            ["branch", "thinking", "endpoint"],
            registry=registry,
        )
        self._revised_iou = Histogram(
            "looktwice_revised_plan_iou",
            "Share of a first plan that its revision keeps.",
            ["endpoint"],
            buckets=PROBABILITY_BUCKETS,
            registry=registry,
        )
        self._labels = Counter(
            "looktwice_labels", "Reflections written by a teacher.", ["teacher"], registry=registry
        )
        self._label_checks_failed = Counter(
            "looktwice_label_checks_failed",
            "Checks that answers of a teacher did not pass.",
            ["teacher", "check"],
            registry=registry,
        )
        self._think_probability = Histogram(
            "looktwice_think_probability",
            "Probability of a second look at the branch.",
            buckets=PROBABILITY_BUCKETS,
            registry=registry,
        )

    def request_answered(self, endpoint: str, method: str, status: int, seconds: float) -> None:
        """Count one request; ``endpoint`` is the route's template, never a caller's path."""
        self._requests.labels(endpoint, method, str(status)).inc()
        self._latency.labels(endpoint).observe(seconds)

    def model_loaded(self, card: ModelCard) -> None:
        """Show which weights answer."""
        self._model.labels(card.name, card.revision, card.engine).set(1)

    def label_asked(self, teacher: str, failed: Iterable[str], *, written: bool) -> None:
        """Count one question to a teacher, and the checks that its answers failed."""
        if written:
            self._labels.labels(teacher).inc()
        for check in failed:
            self._label_checks_failed.labels(teacher, check).inc()

    def draw_finished(self, draw: Draw, thinking: Thinking, endpoint: str) -> None:
        """Count one draw."""
        self._branches.labels(BRANCH_LABELS[draw.branch], thinking, endpoint).inc()
        if draw.plan is not None and draw.revised_plan is not None:
            self._revised_iou.labels(endpoint).observe(plan_iou(draw.plan, draw.revised_plan))
        if draw.think_probability is not None:
            self._think_probability.observe(draw.think_probability)
        for section, tokens in draw.tokens.items():
            self._tokens.labels(section).observe(tokens)
