"""The OpenAI teacher against a real OpenAI-compatible server: vLLM on a CPU, with a tiny model that sees."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

pytest.importorskip("vllm", reason="runs in vLLM's own environment (make test-vllm)", exc_type=ImportError)

import torch
from transformers import (
    Qwen2_5_VLConfig,
    Qwen2_5_VLForConditionalGeneration,
    Qwen2_5_VLProcessor,
    Qwen2VLImageProcessor,
    Qwen2VLVideoProcessor,
)

from looktwice.clients.labelling.teachers.openai import OpenAiSettings, OpenAiTeacher
from looktwice.clients.labelling.teachers.service import ServiceTeacher
from looktwice.clients.labelling.teachers.teacher import (
    Answer,
    CheckedReflection,
    Question,
    ReflectionRefused,
    TeacherClosed,
    TeacherError,
    ask,
)
from looktwice.model.network.nano_corpus import nano_corpus
from looktwice.model.network.vocabulary import build_nano_tokenizer
from looktwice.service.operations.settings import Settings
from tests.clients.labelling.builds import GOOD
from tests.service.scenes import scene
from tests.service.scripted_engine import KEEP_ON, SLOW_DOWN, ScriptedEngine
from tests.service.serving import serve
from tests.sockets import free_port

START_WITHIN_S = 240
KEY = "sk-of-a-test"
QUESTION = Question(scene(), KEEP_ON, SLOW_DOWN)
CHAT = (
    "{% for m in messages %}<|im_start|>{{ m['role'] }}\n"
    "{% if m['content'] is string %}{{ m['content'] }}{% else %}{% for part in m['content'] %}"
    "{% if part['type'] == 'text' %}{{ part['text'] }}"
    "{% else %}<|vision_start|><|image_pad|><|vision_end|>{% endif %}"
    "{% endfor %}{% endif %}<|im_end|>\n{% endfor %}<|im_start|>assistant\n"
)


def write_tiny(folder: Path) -> None:
    """A random Qwen2.5-VL that takes pictures and talks nonsense."""
    tokenizer = build_nano_tokenizer(nano_corpus(), 16)
    tokenizer.add_tokens(["<|image_pad|>"], special_tokens=True)
    tokenizer.chat_template = CHAT
    ids: Any = {
        name: tokenizer.convert_tokens_to_ids(f"<|{name}|>")
        for name in ("im_end", "image_pad", "video_pad", "vision_start", "vision_end")
    }
    config = Qwen2_5_VLConfig(
        text_config={
            "hidden_size": 128,
            "intermediate_size": 256,
            "num_hidden_layers": 2,
            "num_attention_heads": 2,
            "num_key_value_heads": 1,
            "vocab_size": -(-len(tokenizer) // 64) * 64,
            "max_position_embeddings": 8192,
            "eos_token_id": ids["im_end"],
            "rope_parameters": {
                "rope_type": "default",
                "mrope_section": [8, 12, 12],
                "rope_theta": 1e6,
            },
        },
        vision_config={
            "depth": 1,
            "hidden_size": 64,
            "intermediate_size": 128,
            "num_heads": 2,
            "out_hidden_size": 128,
            "fullatt_block_indexes": [0],
        },
        image_token_id=ids["image_pad"],
        video_token_id=ids["video_pad"],
        vision_start_token_id=ids["vision_start"],
        vision_end_token_id=ids["vision_end"],
        tie_word_embeddings=False,
    )
    torch.manual_seed(0)
    network: Any = Qwen2_5_VLForConditionalGeneration(config)
    network.to(torch.bfloat16).save_pretrained(folder)
    pixels: Any = {"min_pixels": 56 * 56, "max_pixels": 112 * 112}
    processor: Any = Qwen2_5_VLProcessor
    processor(
        Qwen2VLImageProcessor(**pixels), tokenizer, Qwen2VLVideoProcessor(**pixels), chat_template=CHAT
    ).save_pretrained(folder)
    tokenizer.save_pretrained(folder)


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("vllm")
    write_tiny(folder / "tiny")
    # The CPU build is installed by another name than the one that its server looks itself up by.
    known = folder / "known" / "vllm-0.32.0+cpu.dist-info"
    known.mkdir(parents=True)
    (known / "METADATA").write_text("Metadata-Version: 2.1\nName: vllm\nVersion: 0.32.0+cpu\n")
    port = free_port()
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(known.parent), os.getcwd()]),
        "HF_HUB_OFFLINE": "1",
        "VLLM_NO_USAGE_STATS": "1",
        "VLLM_CPU_KVCACHE_SPACE": "1",
        "VLLM_PLUGINS": "",
    }
    command = [
        *(sys.executable, "-m", "vllm.entrypoints.openai.api_server"),
        *("--model", str(folder / "tiny"), "--served-model-name", "tiny", "--api-key", KEY),
        *("--host", "127.0.0.1", "--port", str(port), "--enforce-eager", "--block-size", "32"),
        *("--max-model-len", "8192", "--limit-mm-per-prompt", '{"image": 8}', "--max-num-seqs", "4"),
    ]
    log = (folder / "log").open("w")
    process = subprocess.Popen(command, env=environment, stdout=log, stderr=subprocess.STDOUT)
    try:
        wait_for(f"http://127.0.0.1:{port}/health", process, folder / "log")
        yield f"http://127.0.0.1:{port}/v1"
    finally:
        process.terminate()
        process.wait(60)
        log.close()


def wait_for(address: str, process: subprocess.Popen[bytes], log: Path) -> None:
    until_s = time.monotonic() + START_WITHIN_S
    while time.monotonic() < until_s and process.poll() is None:
        try:
            if httpx.get(address).status_code == 200:
                return
        except httpx.TransportError:
            time.sleep(0.5)
    raise AssertionError(f"vLLM did not start:\n{log.read_text()[-4000:]}")


async def asked(settings: OpenAiSettings) -> tuple[CheckedReflection | None, list[Answer]]:
    """What comes of the question, None where it is refused, and all answers."""
    teacher, answers = OpenAiTeacher(settings), list[Answer]()
    try:
        return await ask(teacher, QUESTION, answers), answers
    except ReflectionRefused:
        return None, answers
    finally:
        await teacher.close()


def test_a_real_endpoint_looks_at_the_pictures_and_answers(url: str) -> None:
    # What the model says is nonsense, so it is told what to say: all else is as with any other.
    choice = {"structured_outputs": {"choice": [GOOD]}}
    reflection, answers = asyncio.run(asked(OpenAiSettings(url, "tiny", KEY, extra_body=choice)))
    assert reflection is not None
    assert reflection.text == GOOD
    (answer,) = answers
    # Eight pictures of 16 tokens each at least, and the rules.
    assert answer.input_tokens > 8 * 16 + 300
    assert answer.output_tokens > 5


def test_the_service_labels_with_a_real_endpoint_behind_it(url: str, tmp_path: Path) -> None:
    choice = {"structured_outputs": {"choice": [GOOD]}}
    teacher = OpenAiTeacher(OpenAiSettings(url, "tiny", KEY, extra_body=choice))

    async def labelled(service: str) -> Answer:
        remote = await ServiceTeacher.connect(service)
        try:
            return await remote.reflect(QUESTION)
        finally:
            await remote.close()

    with serve(ScriptedEngine(), Settings(bundled_scenes=tmp_path / "none"), teacher=teacher) as served:
        answer = asyncio.run(labelled(served.url))
    assert answer.text == GOOD
    assert answer.input_tokens > 8 * 16 + 300


def test_nonsense_is_asked_again_and_refused(url: str) -> None:
    refused, answers = asyncio.run(asked(OpenAiSettings(url, "tiny", KEY, max_tokens=60)))
    assert refused is None
    assert len(answers) == 3
    assert answers[1].input_tokens > answers[0].input_tokens, "told what was wrong"


def test_a_wrong_key_or_model_is_told(url: str) -> None:
    with pytest.raises(TeacherClosed, match="401"):
        asyncio.run(asked(OpenAiSettings(url, "tiny", "sk-wrong")))
    with pytest.raises(TeacherClosed, match="404"):
        asyncio.run(asked(OpenAiSettings(url, "other", KEY)))
    with pytest.raises(TeacherError, match="400"):
        asyncio.run(asked(OpenAiSettings(url, "tiny", KEY, temperature=-3.0)))
