"""Settings of the service, from the environment (``LOOKTWICE_…``)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict

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
