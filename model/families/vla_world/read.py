"""What a response of VLA-World says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

from model.driving.perceived import Perceived, PerceivedAgent
from model.families.family import Decode, Foreseen, NextPicture, Reading
from model.families.vla_world import format as its
from model.formats.pieces import Value, Values

_CAMERAS = {written: camera for camera, written in its.CAMERA_OPTIONS.items()}


def read(values: Values, decode: Decode) -> Reading:
    """Its waypoints and what it foresees. A trajectory has no codes."""
    return Reading(its.read_trajectory(values[its.ANSWER]), foreseen=_foreseen(values))


def thoughts_text(values: tuple[Value, ...]) -> str | None:
    """The text of its thoughts; None where nobody comes near."""
    [notable] = values
    return its.told_thoughts(notable) or None


def _foreseen(values: Values) -> Foreseen:
    objects, left_m, right_m = cast("tuple[Value, float, float]", values.all(its.PERCEPTION))
    point, direction = values.all(its.PREDICTION)
    [(x_m, y_m)] = its.read_points((point,)).tolist()
    picture = None
    if its.VISUAL in values:
        codes, camera = cast("tuple[tuple[int, ...], str]", values.all(its.VISUAL))
        picture = NextPicture(_CAMERAS[camera], tuple(codes))
    agents = tuple(_agents(objects, values[its.THINK]))
    return Foreseen(Perceived(agents, left_m, right_m), x_m, y_m, str(direction), picture)


def _agents(objects: Value, thoughts: Value) -> list[PerceivedAgent]:
    """Who is perceived; when somebody comes near, the thoughts tell."""
    told = cast("Sequence[dict[str, Any]]", objects)
    near_s = {
        _who(thought): float(thought["time_s"]) for thought in cast("Sequence[dict[str, Any]]", thoughts)
    }
    agents = []
    for each in told:
        [(x_m, y_m)] = its.read_points((each,)).tolist()
        near = near_s.get(_who(each))
        agents.append(PerceivedAgent(each["kind"], x_m, y_m, each["length_m"], each["width_m"], near))
    return agents


def _who(told: dict[str, Any]) -> tuple[str, float, float]:
    return told["kind"], told["lateral_m"], told["forward_m"]
