from __future__ import annotations

import asyncio
import base64
import email.utils
import gzip
import json
import time
from collections.abc import AsyncIterator
from typing import Any

import pytest
from fastapi import FastAPI
from hypothesis import given
from starlette.responses import StreamingResponse
from starlette.types import ASGIApp

from looktwice.clients.labelling.checks import FailedCheck, check_reflection
from looktwice.clients.labelling.teachers.openai import OpenAiSettings, OpenAiTeacher
from looktwice.clients.labelling.teachers.phrase_answers import phrases_of
from looktwice.clients.labelling.teachers.teacher import (
    Answer,
    Question,
    TeacherBusy,
    TeacherClosed,
    TeacherError,
    ask,
)
from looktwice.clients.retries import with_retries
from looktwice.model.driving.phrases import HEADS, Facts, head_of
from tests.clients.labelling.builds import GOOD, LEAKING, ChatServer, completion
from tests.model.driving.strategies import facts
from tests.service.scenes import scene
from tests.service.scripted_engine import KEEP_ON, SLOW_DOWN
from tests.sockets import listening

QUESTION = Question(scene(), KEEP_ON, SLOW_DOWN, seed=7)


def answer(server: ChatServer, complaints: tuple[FailedCheck, ...] = (), **settings: object) -> Answer:
    """One answer of a teacher over a real socket."""

    async def asking(url: str) -> Answer:
        teacher = OpenAiTeacher(OpenAiSettings(f"{url}/v1", "some-vlm", **settings))  # type: ignore[arg-type]
        try:
            return await teacher.reflect(QUESTION, complaints)
        finally:
            await teacher.close()

    with listening(server.app()) as (url, _):
        return asyncio.run(asking(url))


def test_the_model_answer_used_here_passes_the_checks() -> None:
    assert check_reflection(GOOD, KEEP_ON, SLOW_DOWN) == []
    assert check_reflection(LEAKING, KEEP_ON, SLOW_DOWN) != []


def test_a_question_holds_pictures_plans_and_rules() -> None:
    server = ChatServer([GOOD])
    found = answer(server, api_key="sk-secret", input_price_usd=2.0, output_price_usd=10.0)
    assert found._replace(cost_usd=0.0) == Answer(GOOD, 1000, 50)
    assert found.cost_usd == pytest.approx(0.0025)
    (body,) = server.asked
    assert server.keys == ["Bearer sk-secret"]
    assert (body["model"], body["temperature"], body["max_tokens"], body["seed"]) == ("some-vlm", 0.7, 300, 7)
    system, user = body["messages"]
    assert "80 words" in system["content"]
    parts = user["content"]
    pictures = [part["image_url"]["url"] for part in parts if part["type"] == "image_url"]
    expected = [image for clip in QUESTION.scene.clips for image in clip.images]
    assert [base64.b64decode(url.removeprefix("data:image/jpeg;base64,")) for url in pictures] == expected
    text = "\n".join(part["text"] for part in parts if part["type"] == "text")
    assert str(KEEP_ON) in text
    assert str(SLOW_DOWN) in text
    assert "front_wide_120" in text


def test_a_second_question_says_what_was_wrong() -> None:
    server = ChatServer([LEAKING, GOOD])

    async def asking(url: str) -> None:
        teacher = OpenAiTeacher(OpenAiSettings(f"{url}/v1/", "some-vlm"))
        reflection = await ask(teacher, QUESTION, [])
        assert (reflection.text, reflection.attempts) == (GOOD, 2)
        await teacher.close()

    with listening(server.app()) as (url, _):
        asyncio.run(asking(url))
    first, second = (json.dumps(body) for body in server.asked)
    assert "'expert'" not in first.replace('\\"', "'")
    assert "do not say 'expert'" in second
    assert server.asked[0]["seed"] != server.asked[1]["seed"]


@pytest.mark.parametrize(
    "sent",
    [
        b"<html>welcome</html>",
        b"{}",
        b'{"choices": []}',
        json.dumps(completion(None)).encode(),
        json.dumps(completion("I was about to", finish_reason="length")).encode(),
    ],
)
def test_rubbish_is_no_answer(sent: bytes) -> None:
    found = answer(ChatServer([sent]))
    assert found.text == ""
    assert found.unusable


@pytest.mark.parametrize("status", [429, 500, 503, 529])
@pytest.mark.parametrize(("header", "wait_s"), [("0.5", 0.5), ("12", 12.0), ("soon", None), (None, None)])
def test_busy_endpoints_say_when_to_come_again(status: int, header: str | None, wait_s: float | None) -> None:
    headers = {} if header is None else {"Retry-After": header}
    with pytest.raises(TeacherBusy, match=str(status)) as busy:
        answer(ChatServer([(status, headers)]))
    assert busy.value.wait_s == wait_s


def test_a_date_is_a_time_to_come_again_too() -> None:
    then = email.utils.formatdate(time.time() + 60, usegmt=True)
    with pytest.raises(TeacherBusy) as busy:
        answer(ChatServer([(503, {"Retry-After": then})]))
    assert busy.value.wait_s == pytest.approx(60, abs=5)


@pytest.mark.parametrize("status", [401, 403, 404])
def test_a_wrong_key_or_model_closes_the_teacher(status: int) -> None:
    with pytest.raises(TeacherClosed, match="told why"):
        answer(ChatServer([(status, {})]))


def test_a_refused_question_is_its_own_matter() -> None:
    with pytest.raises(TeacherError) as refused:
        answer(ChatServer([(400, {})]))
    assert not isinstance(refused.value, TeacherBusy | TeacherClosed)


def test_nobody_there_is_busy() -> None:
    teacher = OpenAiTeacher(OpenAiSettings("http://127.0.0.1:9/v1", "some-vlm", timeout_s=2.0))
    with pytest.raises(TeacherBusy, match="Connect"):
        asyncio.run(teacher.reflect(QUESTION))


def test_the_key_is_never_shown() -> None:
    settings = OpenAiSettings("http://x/v1", "some-vlm", api_key="sk-secret", extra_body={"top_k": 3})
    teacher = OpenAiTeacher(settings)
    assert "sk-secret" not in f"{settings!r} {teacher.name} {teacher.revision}"
    assert "top_k" in teacher.revision, "what changes answers is a part of the key"


def test_fields_can_be_put_in_and_taken_out() -> None:
    server = ChatServer([GOOD])
    answer(server, extra_body={"max_tokens": None, "temperature": None, "max_completion_tokens": 99})
    assert not {"max_tokens", "temperature"} & server.asked[0].keys()
    assert server.asked[0]["max_completion_tokens"] == 99


def slow_app(part: bytes, pause_s: float, parts: int) -> FastAPI:
    """An endpoint whose answer comes in parts, with a pause behind each."""
    app = FastAPI()

    @app.post("/v1/chat/completions")
    async def complete() -> StreamingResponse:
        async def sent() -> AsyncIterator[bytes]:
            for _ in range(parts):
                yield part
                await asyncio.sleep(pause_s)

        return StreamingResponse(sent(), media_type="application/json")

    return app


def asked_of(app: ASGIApp, timeout_s: float) -> Answer:
    async def asking(url: str) -> Answer:
        teacher = OpenAiTeacher(OpenAiSettings(f"{url}/v1", "some-vlm", timeout_s=timeout_s))
        try:
            return await teacher.reflect(QUESTION)
        finally:
            await teacher.close()

    with listening(app) as (url, _):
        return asyncio.run(asking(url))


def test_an_answer_that_trickles_in_is_given_up() -> None:
    # Each part comes well within the time of an answer; together they never would.
    with pytest.raises(TeacherBusy, match="no whole answer after 1 s"):
        asked_of(slow_app(b" ", 0.05, 10_000), timeout_s=1.0)


def test_an_answer_without_end_is_given_up() -> None:
    with pytest.raises(TeacherError, match="more than 1000000 bytes") as refused:
        asked_of(slow_app(b" " * 100_000, 0.0, 1000), timeout_s=30.0)
    assert not isinstance(refused.value, TeacherBusy)


def test_a_packed_answer_is_not_unpacked() -> None:
    """A few kB can unpack to gigabytes."""

    async def bomb(scope: Any, receive: Any, send: Any) -> None:
        headers = [(b"content-encoding", b"gzip")]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": gzip.compress(bytes(50_000_000))})

    assert "chat completion" in asked_of(bomb, timeout_s=30.0).unusable


@pytest.mark.parametrize("count", [-5, 10**400])
def test_counts_that_cannot_be_make_no_answer(count: int) -> None:
    told = completion(GOOD)
    told["usage"]["completion_tokens"] = count
    found = answer(ChatServer([json.dumps(told).encode()]), output_price_usd=10.0)
    assert found.unusable
    assert (found.input_tokens, found.output_tokens) == (0, 0)


def test_who_asks_to_be_asked_again_at_once_is_not() -> None:
    server = ChatServer([(503, {"Retry-After": "-5"})])

    async def asking(url: str) -> None:
        teacher = OpenAiTeacher(OpenAiSettings(f"{url}/v1", "some-vlm"))
        try:
            await with_retries(lambda: ask(teacher, QUESTION, []), 2.0)
        finally:
            await teacher.close()

    with listening(server.app()) as (url, _), pytest.raises(TeacherBusy):
        asyncio.run(asking(url))
    assert 2 <= len(server.asked) <= 12


SEEN: dict[str, object] = {
    "seen": "A standing vehicle",
    "place": "my lane",
    "ahead_m": 18,
    "consequence": "too close",
    "correction": "slower",
}


def told(**changes: object) -> str:
    return json.dumps({"statements": [SEEN | changes]})


def test_a_teacher_may_fill_in_facts_that_become_phrases() -> None:
    server = ChatServer([told()])
    text = answer(server, reflection="phrases").text
    assert text == (
        "A standing vehicle is in my lane some 20 metres ahead."
        " Going on like this would bring me too close, so I should slow down sooner."
    )
    assert check_reflection(text, KEEP_ON, SLOW_DOWN) == []
    (body,) = server.asked
    fields = body["response_format"]["json_schema"]["schema"]["$defs"]["ToldStatement"]["properties"]
    assert "A standing vehicle" in fields["seen"]["enum"]
    assert "JSON" in body["messages"][0]["content"]
    assert "paragraph" not in body["messages"][1]["content"][-1]["text"]


@pytest.mark.parametrize(
    ("written", "complaint"),
    [
        ("I should slow down.", "answer with the JSON"),
        (told(seen="A unicorn"), "'A unicorn' is none of"),
        (told(place=None), "needs a place"),
        (told(ahead_m=400), "from 0 to 100"),
        (told(consequence="wrong way"), "is no reason for"),
        (json.dumps({"statements": [SEEN, SEEN]}), "one change of each track"),
        (told(colour="red"), "answer with the JSON"),
    ],
)
def test_facts_that_do_not_go_together_are_asked_for_again(written: str, complaint: str) -> None:
    found = answer(ChatServer([written]), reflection="phrases")
    assert found.text == ""
    assert complaint in found.unusable


@given(facts())
def test_every_reflection_in_phrases_can_be_told_in_fields(facts: Facts) -> None:
    statements = [
        {
            "seen": next(text for text, head in HEADS.items() if head == head_of(each.cue)),
            "place": getattr(each.cue, "place", None),
            "ahead_m": getattr(each.cue, "ahead_m", None),
            "consequence": each.consequence,
            "correction": each.correction,
        }
        for each in facts.statements
    ]
    assert phrases_of(json.dumps({"statements": statements})) == str(facts)
