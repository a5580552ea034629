"""Spans reach a collector over a real socket, as OTLP."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import pytest
from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor

from looktwice.model.engines.engine import EngineError
from looktwice.service.app import create_app
from looktwice.service.operations.settings import Settings
from looktwice.service.operations.traces import Traces, traces_from_environment
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served, body
from tests.sockets import listening


class Collector(HTTPServer):
    """Keeps the spans it is sent."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.spans: list[Any] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/v1/traces"


class _Handler(BaseHTTPRequestHandler):
    def do_POST(self) -> None:
        message = ExportTraceServiceRequest()
        message.ParseFromString(self.rfile.read(int(self.headers["Content-Length"])))
        assert isinstance(self.server, Collector)
        for resource in message.resource_spans:
            for scope in resource.scope_spans:
                self.server.spans += scope.spans
        self.send_response(200)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def collector() -> Iterator[Collector]:
    with Collector() as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def attributes(span: Any) -> dict[str, Any]:
    return {each.key: each.value for each in span.attributes}


def test_a_plan_is_a_span_within_its_request_and_its_callers_trace(
    collector: Collector, engine: ScriptedEngine
) -> None:
    import httpx

    provider = TracerProvider(shutdown_on_exit=False)
    provider.add_span_processor(SimpleSpanProcessor(OTLPSpanExporter(collector.url)))
    app = create_app(engine, Settings(), traces=Traces(provider.get_tracer("test")))
    trace_id = "0af7651916cd43dd8448eb211c80319c"
    with listening(app) as (url, loop), httpx.Client(base_url=url, timeout=30) as http:
        served = Served(engine, url, http, loop)
        served.until_ready()
        headers = {"traceparent": f"00-{trace_id}-b7ad6b7169203331-01"}
        http.post("/v1/plan", json=body(n=3, thinking="always", deadline_ms=9000), headers=headers)
        http.post("/v1/plan", json=body() | {"format": "haiku"})
        http.get("/cars/7")
        engine.failure = EngineError("broke")
        http.post("/v1/plan", json=body())
        served.until(lambda: sum(span.name.startswith("POST") for span in collector.spans) == 3)
    provider.shutdown()
    plan = next(span for span in collector.spans if span.name == "generate_content scripted")
    request = next(span for span in collector.spans if span.span_id == plan.parent_span_id)
    assert plan.trace_id.hex() == request.trace_id.hex() == trace_id
    assert request.parent_span_id.hex() == "b7ad6b7169203331"
    assert attributes(request)["http.response.status_code"].int_value == 200
    told = attributes(plan)
    assert told["gen_ai.request.model"].string_value == "scripted"
    assert told["gen_ai.request.choice.count"].int_value == 3
    assert told["gen_ai.usage.output_tokens"].int_value == 3 * 149
    assert told["looktwice.think_rate"].double_value == 1.0
    assert told["looktwice.deadline_ms"].int_value == 9000
    names = [span.name for span in collector.spans if not span.name.startswith("generate")]
    assert sorted(names) == ["GET", "POST /v1/plan", "POST /v1/plan", "POST /v1/plan"]
    failed = [span for span in collector.spans if span.status.code == span.status.STATUS_CODE_ERROR]
    assert [attributes(span)["http.response.status_code"].int_value for span in failed] == [503]
    refused = [span for span in collector.spans if span.name.startswith("generate") and span is not plan]
    assert [attributes(span)["error.type"].string_value for span in refused] == [
        "unknown-format",
        "engine-failed",
    ]


def test_nothing_is_sent_unless_asked_for() -> None:
    assert traces_from_environment({})._tracer is None
    disabled = {"OTEL_EXPORTER_OTLP_ENDPOINT": "http://localhost:4318", "OTEL_SDK_DISABLED": "true"}
    assert traces_from_environment(disabled)._tracer is None
