"""Everything the service counts for Prometheus."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Final

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    disable_created_metrics,
)
from prometheus_client.core import CounterMetricFamily
from prometheus_client.registry import Collector

from looktwice.model.driving.agreement import PARTS, Agreement
from looktwice.model.driving.plan import plan_iou
from looktwice.model.engines.engine import Draw, EngineLoad, Thinking
from looktwice.model.network.model_card import ModelCard
from looktwice.service.admission.places import Admission
from looktwice.service.operations.logs import lines_lost
from looktwice.service.problems import REJECTIONS, ProblemKind

LATENCY_BUCKETS_S: Final = (
    *(0.025, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.5, 0.75),
    *(1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0, 60.0),
)
"""Planners ask for tens of milliseconds; small CPUs take seconds."""
QUEUE_BUCKETS_S: Final = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
TOKEN_BUCKETS: Final = (1, 2, 5, 10, 20, 40, 60, 80, 100, 150, 200, 300, 500)
PROBABILITY_BUCKETS: Final = tuple(step / 10 for step in range(1, 11))

# When a series began is of use to nobody here, and in Prometheus' own format it is one more gauge each.
disable_created_metrics()  # type: ignore[no-untyped-call]


class _LinesLost(Collector):
    """Counted by the log itself, which cannot wait for a registry."""

    def collect(self) -> Iterable[CounterMetricFamily]:
        text = "Lines of the log that nobody took in time."
        yield CounterMetricFamily("looktwice_log_lines_lost", text, value=lines_lost())


class Metrics:
    """The service's metrics in one registry: ``looktwice_…``, and ``process_…`` of its process.

    The think rate is ``looktwice_branches_total{branch="think"}`` over all branches; where a caller forced
    it, ``thinking`` is not ``adaptive``.
    """

    def __init__(self, registry: CollectorRegistry) -> None:
        self.registry = registry
        ProcessCollector(registry=registry)
        self._requests = Counter(
            "looktwice_requests",
            "Requests answered; status 499 is a caller that left.",
            ["endpoint", "method", "status"],
            registry=registry,
        )
        self._latency = Histogram(
            "looktwice_request_seconds",
            "From a request's headers to the end of its answer; status is a class such as 2xx.",
            ["endpoint", "status"],
            buckets=LATENCY_BUCKETS_S,
            registry=registry,
        )
        self.plans_in_flight = Gauge(
            "looktwice_plans_in_flight", "Scenes the engine is planning for.", registry=registry
        )
        self.ready = Gauge("looktwice_ready", "1 while requests can be served.", registry=registry)
        self.draining = Gauge(
            "looktwice_draining", "1 while the service finishes what it has accepted.", registry=registry
        )
        self._rejections = Counter(
            "looktwice_rejections",
            "Requests, or scenes of batches, that were not served, by the problem that callers were told.",
            ["reason"],
            registry=registry,
        )
        self._failures = Counter(
            "looktwice_failures_told",
            "Failures told in an answer of status 200: in a stream, or of a scene of a batch.",
            ["reason"],
            registry=registry,
        )
        self._queue = Histogram(
            "looktwice_queue_seconds",
            "Of a scene, for its turn in a batch and for its place in the engine.",
            buckets=QUEUE_BUCKETS_S,
            registry=registry,
        )
        self._engine = Histogram(
            "looktwice_engine_seconds",
            "In the engine, its queue included.",
            ["endpoint"],
            buckets=LATENCY_BUCKETS_S,
            registry=registry,
        )
        self._passes = Histogram(
            "looktwice_response_passes",
            "Passes through the network for a draw, its prompt apart.",
            buckets=TOKEN_BUCKETS,
            registry=registry,
        )
        self._response_tokens = Counter(
            "looktwice_response_tokens",
            "Tokens of draws: forced by the format, or free.",
            ["choice"],
            registry=registry,
        )
        self._deadlines = Counter(
            "looktwice_deadlines",
            "Scenes with a deadline, by whether they were answered in time.",
            ["outcome"],
            registry=registry,
        )
        self._restarts = Counter(
            "looktwice_engine_restarts", "Engines that broke and were started again.", registry=registry
        )
        self._swaps = Counter(
            "looktwice_checkpoint_swaps",
            "Checkpoints that were to replace the one that answers.",
            ["outcome"],
            registry=registry,
        )
        # The first failure is the one to be told of, and nothing rises that begins at 1.
        for outcome in ("done", "failed"):
            self._swaps.labels(outcome)
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
        self._disagreements = Counter(
            "looktwice_disagreements",
            "Draws with parts that do not agree, by which do not.",
            ["parts", "endpoint"],
            registry=registry,
        )
        for parts in PARTS:
            for endpoint in ("plan", "reflect"):
                self._disagreements.labels(parts, endpoint)
        self._inconsistent = Counter(
            "looktwice_inconsistent_draws",
            "Draws with any parts that do not agree, each once, labelled as branches are.",
            ["branch", "thinking", "endpoint"],
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
        self._feedback = Counter(
            "looktwice_feedback",
            "Trajectories that feedback was given on, by who wrote it and whether they were correct.",
            ["teacher", "verdict"],
            registry=registry,
        )
        self._teacher_tokens = Counter(
            "looktwice_teacher_tokens",
            "Tokens of teachers' answers, taken or not, as the teachers count.",
            ["teacher", "direction"],
            registry=registry,
        )
        self._teacher_cost = Counter(
            "looktwice_teacher_cost_usd",
            "What teachers' answers cost, taken or not, at the prices of the settings.",
            ["teacher"],
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
        self._latency.labels(endpoint, f"{status // 100}xx").observe(seconds)

    def watch(self, engine_load: Callable[[], EngineLoad], admission: Admission) -> None:
        """Read what is full, and of what, whenever Prometheus asks."""

        def gauge(name: str, text: str, value: Callable[[], float]) -> None:
            Gauge(name, text, registry=self.registry).set_function(value)

        gauge("looktwice_kv_rows", "Draws that the engine has memory for.", lambda: engine_load().rows)
        gauge(
            "looktwice_kv_rows_used",
            "Draws that its memory is reserved for.",
            lambda: engine_load().rows_used,
        )
        gauge(
            "looktwice_capacity_draws",
            "Draws that are accepted at once at most.",
            lambda: admission.draws,
        )
        gauge(
            "looktwice_accepted_draws",
            "Draws accepted and not answered; those of batches whose turn has not come apart.",
            lambda: sum(place.draws for place in admission.places),
        )
        gauge(
            "looktwice_queue_scenes",
            "Scenes accepted that the engine has not begun with.",
            lambda: len(admission.waiting),
        )
        gauge(
            "looktwice_queue_draws",
            "Draws accepted that the engine has not begun with.",
            lambda: sum(place.draws for place in admission.waiting),
        )
        self.registry.register(_LinesLost())

    def count_problem(self, kind: ProblemKind) -> None:
        """Count a request, or a scene of a batch, that may have been right and was not served."""
        if kind in REJECTIONS:
            self._rejections.labels(kind.slug).inc()

    def count_problem_within(self, kind: ProblemKind) -> None:
        """Count a problem that no status shows, since it is told in a stream or in a batch's answer."""
        self.count_problem(kind)
        if kind.status >= 500 and kind.status != 503:
            self._failures.labels(kind.slug).inc()

    def answered(self, endpoint: str, queue_s: float, engine_s: float) -> None:
        """Count one scene that was planned for."""
        self._queue.observe(queue_s)
        self._engine.labels(endpoint).observe(engine_s)

    def count_deadline(self, *, met: bool) -> None:
        """Count one scene with a deadline, whether it was answered or given up."""
        self._deadlines.labels("met" if met else "missed").inc()

    def engine_restarted(self) -> None:
        """Count an engine that broke and runs again."""
        self._restarts.inc()

    def checkpoint_swapped(self, outcome: str) -> None:
        """Count an attempt to replace the checkpoint."""
        self._swaps.labels(outcome).inc()

    def model_loaded(self, card: ModelCard) -> None:
        """Show which weights answer."""
        self._model.clear()
        self._model.labels(card.name, card.revision, card.engine).set(1)

    def count_label(self, teacher: str, failed: Iterable[str], *, written: bool) -> None:
        """Count one question to a teacher, and the checks that its answers failed."""
        if written:
            self._labels.labels(teacher).inc()
        for check in failed:
            self._label_checks_failed.labels(teacher, check).inc()

    def count_feedback(self, teacher: str, *, correct: bool) -> None:
        """Count feedback on one trajectory."""
        self._feedback.labels(teacher, "correct" if correct else "wrong").inc()

    def feedback_failed(self, teacher: str, failed: Iterable[str]) -> None:
        """Count the checks that a teacher's feedback did not pass."""
        for check in failed:
            self._label_checks_failed.labels(teacher, check).inc()

    def teacher_paid(self, teacher: str, input_tokens: int, output_tokens: int, cost_usd: float) -> None:
        """Count what a question to a teacher took."""
        self._teacher_tokens.labels(teacher, "input").inc(input_tokens)
        self._teacher_tokens.labels(teacher, "output").inc(output_tokens)
        self._teacher_cost.labels(teacher).inc(cost_usd)

    def draw_finished(self, draw: Draw, agreement: Agreement, thinking: Thinking, endpoint: str) -> None:
        """Count one draw, and what does not agree in it."""
        taken = "none" if draw.branch is None else "think" if draw.looked_twice else "direct"
        self._branches.labels(taken, thinking, endpoint).inc()
        # Nothing is added for the others, so that every share begins at 0 instead of missing.
        self._inconsistent.labels(taken, thinking, endpoint).inc(agreement.consistent is False)
        for parts in agreement.disagreements:
            self._disagreements.labels(parts, endpoint).inc()
        if draw.plan is not None and draw.revised_plan is not None:
            self._revised_iou.labels(endpoint).observe(plan_iou(draw.plan, draw.revised_plan))
        if draw.think_probability is not None:
            self._think_probability.observe(draw.think_probability)
        for section, tokens in draw.tokens.items():
            self._tokens.labels(section).observe(tokens)
        self._passes.observe(draw.passes)
        self._response_tokens.labels("free").inc(draw.chosen)
        self._response_tokens.labels("forced").inc(sum(draw.tokens.values()) - draw.chosen)
