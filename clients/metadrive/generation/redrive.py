"""Episodes of a planner's own drives once more: it drives again, and meets what it met."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Protocol

from looktwice.clients.metadrive.closed_loop.drives import DriveConfig
from looktwice.clients.metadrive.closed_loop.pilots import Pilot
from looktwice.clients.metadrive.drawing.rig import Rig
from looktwice.clients.metadrive.generation.blocks import GenerateConfig, pilot_of, rig_of
from looktwice.clients.metadrive.generation.own_states import drive_among
from looktwice.clients.metadrive.world.episode import EpisodeWorld
from looktwice.model.driving.scene import Scene


class DescribedPilot(Pilot, Protocol):
    """A pilot that tells its name and revision, as manifests do."""

    @property
    def described(self) -> str:
        """Both."""
        ...


class Redriver:
    """A pilot that drives as a folder's config says.

    Args:
        config: of the generator.
        pilot: that drove when the scenes were made.
    """

    def __init__(self, config: GenerateConfig, pilot: Pilot) -> None:
        self._config, self._pilot = config, pilot

    def drive(self, seed: int, meet: Callable[[EpisodeWorld, Scene], None]) -> None:
        """Drive an episode, and tell ``meet`` of each plan's moment; raises `MapError`."""
        pilot = pilot_of(self._config, self._pilot, seed)
        drives = DriveConfig(self._config.duration_s)
        drive_among(seed, pilot, self._rig, drives, meet, hazards=self._config.hazards)

    @cached_property
    def _rig(self) -> Rig | None:
        return rig_of(self._config)
