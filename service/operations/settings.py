"""Settings of the service, from the environment (``LOOKTWICE_…``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, Literal

from pydantic import Field, SecretStr
from pydantic_settings import BaseSettings, SettingsConfigDict

from looktwice.clients.labelling.teachers.openai import OpenAiSettings, OpenAiTeacher
from looktwice.clients.labelling.teachers.rules import RuleTeacher
from looktwice.clients.labelling.teachers.teacher import Teacher
from looktwice.model.bundled import SCENES
from looktwice.model.driving.phrases import ReflectionLanguage
from looktwice.service.operations.keys import Keys

LOOPBACK: Final = frozenset({"localhost", "127.0.0.1", "::1"})


class Settings(BaseSettings):
    """What an operator decides about the service.

    Attributes:
        bundled_scenes: scene file or folder that the inspector page offers; a missing one means no scenes.
        max_body_bytes: larger request bodies get a 413 problem.
        max_held_bytes: of the bodies of all requests under way; the one that goes beyond gets a 429 problem.
        large_bytes_per_s: of bodies of more than 1 MB, as many are read a second, all together.
        max_scene_file_bytes: the same for scene files dropped onto the page.
        log_format: ``json`` for machines, ``console`` for people.
        api_keys_file: a line ``name:sha256`` for each key; without it everybody may ask.
        open: listen beyond this machine although there are no keys.
        hosts: names that a service without keys answers to, but for probes, which it always answers; by
            default this machine's own for itself, and any for a service that is open.
        rate_limit: draws per key, such as ``6000/minute``; None for no limit.
        max_draws, max_scenes: accepted at once, those that wait included; the next one gets a 429 problem,
            but a scene that would be alone is let in. Few keep answers quick under a burst, many keep a
            device busy: docs/operations.md has figures.
        max_connections: open at once; more are answered 503.
        queue_timeout_s: a scene that has not begun by then gets a 503 problem.
        decode_timeout_s: a scene that has begun and is not finished by then gets a 504 problem.
        headers_timeout_s, body_timeout_s: a connection that takes longer to send them is closed, or gets a
            408 problem.
        write_timeout_s: a caller that takes nothing of its answer for so long is disconnected.
        stall_s: a service that answered nobody for so long lately, or where requests wait for so long to be
            read, checked or decoded, says that it is not ready.
        drain_s: after SIGTERM accepted requests have so long to finish.
        drain_notice_s: after SIGTERM the service listens, and says that it is draining, at least so long.
        idempotency_s: answers are kept for so long for callers that ask again with the same key.
        checkpoints: folder whose checkpoints may replace the one that answers; None where none may.
        operators: owners of keys that may replace it.
        cors_origins: web pages of these origins may ask.
    """

    model_config = SettingsConfigDict(env_prefix="LOOKTWICE_", frozen=True, extra="ignore")

    bundled_scenes: Path = SCENES
    max_body_bytes: int = Field(default=24_000_000, gt=0)
    max_held_bytes: int = Field(default=256_000_000, gt=0)
    large_bytes_per_s: int = Field(default=16_000_000, gt=0)
    max_scene_file_bytes: int = Field(default=8_000_000, gt=0)
    log_format: Literal["json", "console"] = "json"
    api_keys_file: Path | None = None
    open: bool = False
    hosts: frozenset[str] | None = None
    rate_limit: str | None = None
    max_draws: int = Field(default=24, gt=0)
    max_scenes: int = Field(default=64, gt=0)
    max_connections: int = Field(default=1024, gt=0)
    queue_timeout_s: float = Field(default=10.0, gt=0)
    decode_timeout_s: float = Field(default=60.0, gt=0)
    headers_timeout_s: float = Field(default=10.0, gt=0)
    body_timeout_s: float = Field(default=30.0, gt=0)
    write_timeout_s: float = Field(default=30.0, gt=0)
    stall_s: float = Field(default=3.0, gt=0)
    drain_s: float = Field(default=25.0, gt=0)
    drain_notice_s: float = Field(default=1.0, ge=0)
    idempotency_s: float = Field(default=600.0, gt=0)
    checkpoints: Path | None = None
    operators: tuple[str, ...] = ("operator",)
    cors_origins: tuple[str, ...] = ()

    def answers_to(self) -> frozenset[str] | None:
        """Names under which it is asked without a key; None for any."""
        if self.hosts is not None:
            return frozenset(host.lower() for host in self.hosts)
        return None if self.open else LOOPBACK

    def keys(self) -> Keys:
        """The keys that open the service; raises `ValueError` where their file is none."""
        return Keys({}) if self.api_keys_file is None else Keys.read(self.api_keys_file)


class TeacherSettings(BaseSettings):
    """Who writes labels.

    Attributes:
        kind: ``rules`` is built in; ``openai`` is any endpoint that speaks OpenAI's chat completions.
        base_url, model, api_key, temperature, max_tokens, timeout_s, input_price_usd, output_price_usd,
            extra_body, reflection, feedback_max_tokens: of the endpoint, see `OpenAiSettings`.
    """

    model_config = SettingsConfigDict(env_prefix="LOOKTWICE_TEACHER_", frozen=True, extra="ignore")

    kind: Literal["rules", "openai"] = "rules"
    base_url: str = "http://127.0.0.1:8001/v1"
    model: str = ""
    api_key: SecretStr | None = None
    temperature: float = Field(default=0.7, ge=0, le=2)
    max_tokens: int = Field(default=300, gt=0)
    timeout_s: float = Field(default=60.0, gt=0)
    input_price_usd: float = Field(default=0.0, ge=0)
    output_price_usd: float = Field(default=0.0, ge=0)
    extra_body: dict[str, Any] = {}
    reflection: ReflectionLanguage = "free_text"
    feedback_max_tokens: int = Field(default=900, gt=0)

    def teacher(self) -> Teacher:
        """The teacher that is set; raises `ValueError` where something is missing."""
        return RuleTeacher() if self.kind == "rules" else OpenAiTeacher(self.openai())

    def openai(self) -> OpenAiSettings:
        """The endpoint that is set; raises `ValueError` where something is missing."""
        if self.kind != "openai" or not self.model:
            raise ValueError("set LOOKTWICE_TEACHER_KIND=openai, …_BASE_URL and …_MODEL")
        key = None if self.api_key is None else self.api_key.get_secret_value()
        told = self.model_dump(exclude={"kind", "api_key"})
        return OpenAiSettings(api_key=key, **told)
