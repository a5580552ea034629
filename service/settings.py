"""Settings of the service, from the environment (``LOOKTWICE_…``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, SecretStr
from pydantic_settings import BaseSettings, SettingsConfigDict

from clients.labelling.teachers.openai import OpenAiSettings, OpenAiTeacher
from clients.labelling.teachers.rules import RuleTeacher
from clients.labelling.teachers.teacher import Teacher
from model.bundled import SCENES


class Settings(BaseSettings):
    """What an operator decides about the service.

    Attributes:
        bundled_scenes: scene file or folder that the inspector page offers; a missing one means no scenes.
        max_body_bytes: larger request bodies get a 413 problem.
        max_scene_file_bytes: the same for scene files dropped onto the page.
        log_format: ``json`` for machines, ``console`` for people.
    """

    model_config = SettingsConfigDict(env_prefix="LOOKTWICE_", frozen=True, extra="ignore")

    bundled_scenes: Path = SCENES
    max_body_bytes: int = Field(default=24_000_000, gt=0)
    max_scene_file_bytes: int = Field(default=8_000_000, gt=0)
    log_format: Literal["json", "console"] = "json"


class TeacherSettings(BaseSettings):
    """Who writes labels.

    Attributes:
        kind: ``rules`` is built in; ``openai`` is any endpoint that speaks OpenAI's chat completions.
        base_url, model, api_key, temperature, max_tokens, timeout_s, input_price_usd, output_price_usd,
            extra_body: of the endpoint, see `OpenAiSettings`.
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
