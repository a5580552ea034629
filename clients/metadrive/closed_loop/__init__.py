"""Cars that drive by somebody's trajectories. A door: others import from here."""

from looktwice.clients.metadrive.closed_loop.driver_table import (
    driver_comparisons,
    driver_rows,
    drives_to_json,
    format_driver_rows,
)
from looktwice.clients.metadrive.closed_loop.drives import EXPERT, Drive, DriveConfig, drive, drive_store
from looktwice.clients.metadrive.closed_loop.film import IMAGINED, Film
from looktwice.clients.metadrive.closed_loop.pilots import ConstantVelocity, Pilot, Planned, ServicePilot
from looktwice.clients.metadrive.drawing.rig import Rig
from looktwice.clients.metadrive.world.maps import MapError

__all__ = [
    "ConstantVelocity",
    "Drive",
    "DriveConfig",
    "EXPERT",
    "Film",
    "IMAGINED",
    "MapError",
    "Pilot",
    "Planned",
    "Rig",
    "ServicePilot",
    "drive",
    "drive_store",
    "driver_comparisons",
    "driver_rows",
    "drives_to_json",
    "format_driver_rows",
]
