"""Traces for OpenTelemetry, after its conventions for generative AI; the only module that knows them.

Conventions: opentelemetry.io/docs/specs/semconv/gen-ai (in development: names may still change). Nothing of
a scene or a response is put into a span, only counts and decisions.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Final, Protocol

import looktwice.clients.wire as wire
from looktwice.model.engines.engine import Draw
from looktwice.model.network.model_card import ModelCard
from looktwice.service.problems import ProblemError

_SYSTEM: Final = "looktwice"


class PlanningSpan(Protocol):
    """The span of one scene."""

    def drew(self, draws: Sequence[Draw]) -> None:
        """The scene was planned for."""


class RequestSpan(Protocol):
    """The span of a request."""

    def answered(self, route: str | None, status: int) -> None:
        """It was answered; ``route`` is the template that its path fits, None where none does."""


class Traces:
    """Where spans go to: nowhere, until a tracer is given.

    Args:
        tracer: an ``opentelemetry.trace.Tracer``; None where traces are not wanted.
    """

    def __init__(self, tracer: Any = None) -> None:
        self._tracer = tracer

    @contextmanager
    def request(
        self, method: str, path: str, headers: Mapping[str, str], *, quiet: bool = False
    ) -> Generator[RequestSpan]:
        """The span of an HTTP request, within the trace that its caller names (W3C ``traceparent``).

        Its name is the method until it is answered: paths are callers' and without number. A ``quiet``
        request, a probe's, has none.
        """
        if self._tracer is None or quiet:
            yield _Nowhere()
            return
        from opentelemetry.propagate import extract
        from opentelemetry.trace import SpanKind

        attributes = {"http.request.method": method, "url.path": path}
        with self._tracer.start_as_current_span(
            method, extract(headers), SpanKind.SERVER, attributes
        ) as span:
            yield _RequestSpan(span, method)

    @contextmanager
    def planning(
        self, asked: wire.PlanRequest | wire.ReflectRequest, card: ModelCard
    ) -> Generator[PlanningSpan]:
        """The span of a scene, from its acceptance to its last draw."""
        if self._tracer is None:
            yield _Nowhere()
            return
        controls = asked.controls
        attributes: dict[str, Any] = {
            "gen_ai.operation.name": "generate_content",
            "gen_ai.provider.name": _SYSTEM,
            "gen_ai.request.model": card.name,
            "gen_ai.request.choice.count": controls.n,
            "gen_ai.request.temperature": controls.temperature,
            "gen_ai.request.top_p": controls.top_p,
            "gen_ai.request.seed": controls.seed,
            "looktwice.model.revision": card.revision,
            "looktwice.thinking": controls.thinking,
        }
        if controls.deadline_ms is not None:
            attributes["looktwice.deadline_ms"] = controls.deadline_ms
        # Not made the current one: generators may be closed in another context than they began in.
        span = self._tracer.start_span(f"generate_content {card.name}", attributes=attributes)
        try:
            yield _Span(span)
        except ProblemError as error:
            span.set_attribute("error.type", error.kind.slug)
            raise
        finally:
            span.end()


class _Nowhere:
    def drew(self, draws: Sequence[Draw]) -> None:
        pass

    def answered(self, route: str | None, status: int) -> None:
        pass


class _RequestSpan:
    def __init__(self, span: Any, method: str) -> None:
        self._span, self._method = span, method

    def answered(self, route: str | None, status: int) -> None:
        from opentelemetry.trace import StatusCode

        self._span.set_attribute("http.response.status_code", status)
        if route is not None:
            self._span.update_name(f"{self._method} {route}")
            self._span.set_attribute("http.route", route)
        if status >= 500:
            self._span.set_status(StatusCode.ERROR)


class _Span:
    def __init__(self, span: Any) -> None:
        self._span = span

    def drew(self, draws: Sequence[Draw]) -> None:
        tokens = sum(sum(draw.tokens.values()) for draw in draws)
        self._span.set_attributes(
            {
                "gen_ai.usage.output_tokens": tokens,
                "gen_ai.response.finish_reasons": ["length" if draw.cut else "stop" for draw in draws],
                "looktwice.think_rate": sum(draw.looked_twice for draw in draws) / len(draws),
                "looktwice.forced_share": 1 - sum(draw.chosen for draw in draws) / max(1, tokens),
                "looktwice.passes": max(draw.passes for draw in draws),
            }
        )


def traces_from_environment(environment: Mapping[str, str]) -> Traces:
    """Traces to the collector that ``OTEL_EXPORTER_OTLP_ENDPOINT`` names, by OTLP over HTTP; else nowhere.

    Raises:
        ValueError: traces are asked for and OpenTelemetry is not installed.
    """
    wanted = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")
    if not any(environment.get(name) for name in wanted) or environment.get("OTEL_SDK_DISABLED") == "true":
        return Traces()
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError as error:
        raise ValueError(f"traces need more ({error}): pip install 'looktwice[otel]'") from error
    name = environment.get("OTEL_SERVICE_NAME", _SYSTEM)
    provider = TracerProvider(resource=Resource.create({"service.name": name}))
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
    return Traces(provider.get_tracer(_SYSTEM))
