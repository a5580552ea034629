"""A teacher behind any OpenAI-compatible endpoint: vLLM, SGLang, Ollama, or a paid one."""

from __future__ import annotations

import asyncio
import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import httpx
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from looktwice.clients.answers import retry_after_s
from looktwice.clients.labelling.checks import FailedCheck
from looktwice.clients.labelling.teachers.feedback_teacher import (
    FEEDBACK_PROMPT_VERSION,
    FEEDBACK_SYSTEM,
    FeedbackQuestion,
)
from looktwice.clients.labelling.teachers.phrase_answers import RESPONSE_FORMAT, phrases_of
from looktwice.clients.labelling.teachers.prompt import PROMPT_VERSION, SYSTEM, Part, Text, user_message
from looktwice.clients.labelling.teachers.teacher import (
    Answer,
    Question,
    TeacherBusy,
    TeacherClosed,
    TeacherError,
)
from looktwice.model.driving.images import media_type
from looktwice.model.driving.phrases import PhraseError, ReflectionLanguage

_BUSY: Final = (408, 409, 425, 429, 500, 502, 503, 504, 529)
_CLOSED: Final = (401, 402, 403, 404, 405)
MAX_ANSWER_BYTES: Final = 1_000_000
"""A paragraph has some kB with everything around it; reasoning that an endpoint tells beside it, tens."""
_MOST_TOKENS: Final = 10_000_000
"""That one answer can have taken: beyond any context there is."""
_SHOWN: Final = 300
"""Characters of an error's body that are told."""


@dataclass(frozen=True)
class OpenAiSettings:
    """Where a teacher is, and how it is asked.

    Attributes:
        base_url: up to and without ``/chat/completions``, such as ``https://api.openai.com/v1``.
        model: as the endpoint calls it.
        api_key: sent as a bearer token; None where none is needed. Never shown or stored.
        temperature, max_tokens: of sampling.
        timeout_s: for one whole answer.
        input_price_usd, output_price_usd: for a million tokens, to count costs by.
        extra_body: more fields of the request, such as an endpoint's own sampling options; null takes a
            field out.
        reflection: what it is to write: a paragraph, or facts (JSON) that are brought into phrases.
        feedback_max_tokens: of the five sections of feedback, which are longer than a paragraph.
    """

    base_url: str
    model: str
    api_key: str | None = field(default=None, repr=False)
    temperature: float = 0.7
    max_tokens: int = 300
    timeout_s: float = 60.0
    input_price_usd: float = 0.0
    output_price_usd: float = 0.0
    extra_body: Mapping[str, Any] = field(default_factory=dict)
    reflection: ReflectionLanguage = "free_text"
    feedback_max_tokens: int = 900


class _Message(BaseModel):
    model_config = ConfigDict(extra="ignore")
    content: str | None = None


class _Choice(BaseModel):
    model_config = ConfigDict(extra="ignore")
    message: _Message
    finish_reason: str | None = None


class _Usage(BaseModel):
    model_config = ConfigDict(extra="ignore")
    prompt_tokens: int = Field(default=0, ge=0, le=_MOST_TOKENS)
    completion_tokens: int = Field(default=0, ge=0, le=_MOST_TOKENS)


class _Completion(BaseModel):
    model_config = ConfigDict(extra="ignore")
    choices: list[_Choice] = []
    usage: _Usage | None = None


class OpenAiTeacher:
    """`looktwice.clients.labelling.teachers.teacher.Teacher` over HTTP; asks once, others decide on asking
    again."""

    def __init__(self, settings: OpenAiSettings) -> None:
        self._settings = settings
        # Packed answers would be measured only once they are unpacked.
        headers = {"Accept-Encoding": "identity"}
        if settings.api_key is not None:
            headers["Authorization"] = f"Bearer {settings.api_key}"
        self._http = httpx.AsyncClient(
            base_url=settings.base_url.rstrip("/") + "/", timeout=settings.timeout_s, headers=headers
        )

    @property
    def name(self) -> str:
        """The model's name at its endpoint."""
        return f"openai:{self._settings.model}"

    @property
    def revision(self) -> str:
        """Prompt and sampling."""
        settings = self._settings
        told = f"prompt {PROMPT_VERSION}, temperature {settings.temperature:g}, {settings.max_tokens} tokens"
        extra = "".join(f", {name}={value}" for name, value in sorted(settings.extra_body.items()))
        return told + extra + ", in phrases" * (settings.reflection == "phrases")

    @property
    def feedback_revision(self) -> str:
        """The same of feedback."""
        settings = self._settings
        told = f"feedback prompt {FEEDBACK_PROMPT_VERSION}, temperature {settings.temperature:g}"
        extra = "".join(f", {name}={value}" for name, value in sorted(settings.extra_body.items()))
        return f"{told}, {settings.feedback_max_tokens} tokens{extra}"

    async def reflect(self, question: Question, complaints: Sequence[FailedCheck] = ()) -> Answer:
        """See `Teacher.reflect`."""
        content = await self._complete(completion_request(self._settings, question, complaints))
        return completion_answer(self._settings, content)

    async def write_feedback(
        self, question: FeedbackQuestion, complaints: Sequence[FailedCheck] = ()
    ) -> Answer:
        """See `FeedbackTeacher.write_feedback`."""
        content = await self._complete(feedback_request(self._settings, question, complaints))
        return completion_answer(replace(self._settings, reflection="free_text"), content)

    async def _complete(self, body: Mapping[str, Any]) -> bytes:
        """What the endpoint answers; raises `TeacherError`."""
        try:
            async with asyncio.timeout(self._settings.timeout_s):
                response = await self._answer(body)
        except TimeoutError:
            told = f"there was no whole answer after {self._settings.timeout_s:g} s"
            raise TeacherBusy(told) from None
        except httpx.HTTPError as error:
            raise TeacherBusy(f"{type(error).__name__}: {error}") from error
        status = response.status_code
        if status in _BUSY:
            raise TeacherBusy(_told(response), retry_after_s(response))
        if status in _CLOSED:
            raise TeacherClosed(_told(response))
        if status != 200:
            raise TeacherError(_told(response))
        return response.content

    async def _answer(self, body: Mapping[str, Any]) -> httpx.Response:
        """The response with its whole body; raises `TeacherError` for one that no completion needs."""
        async with self._http.stream("POST", "chat/completions", json=body) as response:
            content = bytearray()
            async for part in response.aiter_raw():
                content += part
                if len(content) > MAX_ANSWER_BYTES:
                    raise TeacherError(f"the answer has more than {MAX_ANSWER_BYTES} bytes")
        return httpx.Response(
            response.status_code,
            headers={"Retry-After": response.headers.get("Retry-After", "")},
            content=bytes(content),
            request=response.request,
        )

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()


def completion_request(
    settings: OpenAiSettings, question: Question, complaints: Sequence[FailedCheck] = ()
) -> dict[str, Any]:
    """The body of POST /chat/completions for a question."""
    body = {
        "model": settings.model,
        "messages": [
            {"role": "system", "content": SYSTEM[settings.reflection]},
            {
                "role": "user",
                "content": [_part(part) for part in user_message(question, complaints, settings.reflection)],
            },
        ],
        "temperature": settings.temperature,
        "max_tokens": settings.max_tokens,
        # Another try gets other random numbers.
        "seed": question.seed + len(complaints),
        "response_format": RESPONSE_FORMAT if settings.reflection == "phrases" else None,
        **settings.extra_body,
    }
    return {name: value for name, value in body.items() if value is not None}


def feedback_request(
    settings: OpenAiSettings, question: FeedbackQuestion, complaints: Sequence[FailedCheck] = ()
) -> dict[str, Any]:
    """The body of POST /chat/completions for a question about a failed plan."""
    told = "".join(f"\n- {each.detail}" for each in dict.fromkeys(complaints))
    again = f"\n\nYou wrote feedback before that cannot be used. This time:{told}" if told else ""
    body = {
        "model": settings.model,
        "messages": [
            {"role": "system", "content": FEEDBACK_SYSTEM},
            {"role": "user", "content": question.prompt + again},
        ],
        "temperature": settings.temperature,
        "max_tokens": settings.feedback_max_tokens,
        "seed": len(complaints),
        **settings.extra_body,
    }
    return {name: value for name, value in body.items() if value is not None}


def completion_answer(settings: OpenAiSettings, content: bytes | str) -> Answer:
    """What a completion says; `Answer.unusable` where it is none."""
    try:
        completion = _Completion.model_validate_json(content)
    except ValidationError:
        return Answer("", unusable="the endpoint did not answer with a chat completion")
    used = completion.usage or _Usage()
    cost_usd = (
        used.prompt_tokens * settings.input_price_usd + used.completion_tokens * settings.output_price_usd
    ) / 1e6
    answer = Answer("", used.prompt_tokens, used.completion_tokens, cost_usd)
    if not completion.choices or not completion.choices[0].message.content:
        return answer._replace(unusable="the last answer was empty")
    choice = completion.choices[0]
    if choice.finish_reason == "length":
        return answer._replace(unusable="write less: the answer was cut off")
    text = (choice.message.content or "").strip()
    if settings.reflection == "free_text":
        return answer._replace(text=text)
    try:
        return answer._replace(text=phrases_of(text))
    except PhraseError as error:
        return answer._replace(unusable=str(error))


def _part(part: Part) -> dict[str, Any]:
    if isinstance(part, Text):
        return {"type": "text", "text": part.text}
    encoded = base64.b64encode(part.image).decode()
    return {"type": "image_url", "image_url": {"url": f"data:{media_type(part.image)};base64,{encoded}"}}


def _told(response: httpx.Response) -> str:
    return f"{response.status_code} {response.reason_phrase}: {response.text[:_SHOWN]}"
