"""The one place where MetaDrive and Panda3D are imported."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import io
import logging
import sys
import warnings
from pathlib import Path
from typing import Any, Final

_PANDA_SETTINGS: Final = """
load-display p3headlessgl
aux-display
notify-level-egldisplay error
notify-level-display error
notify-level error
default-directnotify-level error
audio-library-name null
framebuffer-multisample 0
multisamples 0
textures-power-2 none
max-texture-dimension 512
model-cache-dir
garbage-collect-states-rate 1.0
"""


_WAYMO: Final = "metadrive.utils.waymo_utils.protos"


class SimulatorMissing(RuntimeError):
    """MetaDrive is not installed; the text says how to install it."""


def _load(name: str) -> Any:
    # Generated for a protobuf of long ago: with a present one its import fails otherwise than where there is
    # none at all, which the simulator is ready for. Nothing here reads Waymo's recordings.
    sys.modules.setdefault(_WAYMO, None)  # type: ignore[arg-type]  # "not to be imported", as the import system has it
    try:
        with (
            warnings.catch_warnings(),
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(io.StringIO()),
        ):
            warnings.simplefilter("ignore")
            return importlib.import_module(name)
    except ImportError as error:
        raise SimulatorMissing(
            f"scene generation needs MetaDrive ({name}: {error}); install it with `make sim`"
        ) from error


def is_installed() -> bool:
    """Whether MetaDrive and Panda3D can be found, without importing them."""
    return all(importlib.util.find_spec(name) is not None for name in ("metadrive", "panda3d", "gltf"))


def panda() -> Any:
    """``panda3d.core``, set up to render without a window."""
    core = _load("panda3d.core")
    if not getattr(core, "_looktwice_ready", False):
        core.loadPrcFileData("looktwice", _PANDA_SETTINGS)
        core._looktwice_ready = True
    return core


def load_model(relative: str) -> Any:
    """One of the simulator's glTF models as a Panda3D node."""
    core = panda()
    converter = _load("gltf.converter")
    return converter.load_model(core.Loader.getGlobalPtr(), str(asset_folder() / relative))


def block_classes() -> dict[str, Any]:
    """The simulator's road blocks by their letter, able to exist without its engine."""
    panda()
    logging.getLogger("gym").setLevel(logging.ERROR)
    base = _load("metadrive.component.block.base_block").BaseBlock
    if not getattr(base, "_looktwice_geometry_only", False):

        def no_bodies(self: Any, skip: bool = False) -> None:
            self.bounding_box = self.block_network.get_bounding_box()

        base._create_in_world = no_bodies
        base.__del__ = lambda self: None
        base._looktwice_geometry_only = True
    blocks = _load("metadrive.component.pgblock.first_block")
    known = {
        "S": ("straight", "Straight"),
        "C": ("curve", "Curve"),
        "X": ("std_intersection", "StdInterSection"),
        "T": ("std_t_intersection", "StdTInterSection"),
        "O": ("roundabout", "Roundabout"),
        "r": ("ramp", "InRampOnStraight"),
        "R": ("ramp", "OutRampOnStraight"),
    }
    found = {
        letter: getattr(_load(f"metadrive.component.pgblock.{module}"), name)
        for letter, (module, name) in known.items()
    }
    return {"I": blocks.FirstPGBlock, **found}


def new_road_network() -> Any:
    """An empty road network of the simulator."""
    return _load("metadrive.component.road_network.node_road_network").NodeRoadNetwork()


def asset_folder() -> Path:
    """Where the simulator's wheel keeps its models."""
    package = _load("metadrive")
    return Path(package.__file__).parent / "assets" / "models"


def version() -> str:
    """The installed version of the simulator."""
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import version as installed_version

    try:
        return installed_version("metadrive-simulator")
    except PackageNotFoundError as error:
        raise SimulatorMissing("MetaDrive is not installed; install it with `make sim`") from error


def described() -> str:
    """The installed simulator with its version, as manifests of scenes tell it."""
    return f"metadrive-simulator {version()}"
