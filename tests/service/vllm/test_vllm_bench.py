"""vLLM's own benchmark, unmodified, against our OpenAI dialect over a real socket."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("vllm", reason="runs in vLLM's own environment (make test-vllm)", exc_type=ImportError)

from looktwice.model.bundled import CHECKPOINT
from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.service.operations.settings import Settings
from tests.service.serving import serve

PROMPTS = 4


def test_vllm_bench_serve_finds_every_request_answered(tmp_path: Path) -> None:
    with serve(TorchEngine(CHECKPOINT, TorchSettings(rows=12)), Settings()) as served:
        command = [
            *(str(Path(sys.executable).with_name("vllm")), "bench", "serve"),
            *("--backend", "openai-chat", "--endpoint", "/v1/chat/completions"),
            *("--base-url", served.url, "--model", "looktwice-nano", "--tokenizer", str(CHECKPOINT)),
            *("--dataset-name", "random-mm", "--random-input-len", "16", "--num-prompts", str(PROMPTS)),
            *("--random-mm-base-items-per-request", "8", "--random-mm-num-mm-items-range-ratio", "0"),
            *("--random-mm-limit-mm-per-prompt", '{"image": 8, "video": 0}'),
            *("--random-mm-bucket-config", "{(128, 224, 1): 1.0}"),
            *("--save-result", "--result-dir", str(tmp_path), "--result-filename", "found.json"),
        ]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
        assert ended.returncode == 0, ended.stderr[-2000:]
        assert (
            served.metric("looktwice_requests_total", endpoint="/v1/chat/completions", status="200")
            >= PROMPTS
        )
    found = json.loads((tmp_path / "found.json").read_text())
    assert (found["completed"], found["failed"]) == (PROMPTS, 0)
    assert found["total_output_tokens"] > PROMPTS
    assert found["mean_ttft_ms"] > 0
