"""What a response of VLA-World says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

from looktwice.model.driving.perceived import Perceived, PerceivedAgent
from looktwice.model.families.family import Decode, Foreseen, NextPicture, Predicted, Reading
from looktwice.model.families.picture_codes import PICTURE_CODES, beside
from looktwice.model.families.vla_world import format as its
from looktwice.model.families.vla_world.actions import Action, counted
from looktwice.model.formats.fixed import Decided
from looktwice.model.formats.pieces import Value, Values

_CAMERAS = {written: camera for camera, written in its.CAMERA_OPTIONS.items()}


def read(values: Values, decode: Decode) -> Reading:
    """Its waypoints, what it foresees, and what it says that it does. A trajectory has no codes."""
    said = cast("dict[str, Any]", values[its.ACTION])
    action = Action(said["lateral"], said["speed"])
    trajectory = its.read_trajectory(values[its.ANSWER])
    return Reading(trajectory, foreseen=_foreseen(values), action=counted(action))


def thoughts_text(values: tuple[Value, ...]) -> str | None:
    """The text of its thoughts; None where nobody comes near."""
    [notable] = values
    return its.thoughts_text(notable) or None


def perceived(values: tuple[Value, ...], thoughts: Value = ()) -> Perceived:
    """What a perception says; when somebody comes near, the thoughts tell."""
    objects, left_m, right_m = cast("tuple[Value, float, float]", values)
    return Perceived(tuple(_agents(objects, thoughts)), left_m, right_m)


def predicted(values: tuple[Value, ...]) -> Predicted:
    """What a prediction says."""
    point, direction = values
    [(x_m, y_m)] = its.read_points((point,)).tolist()
    return Predicted(x_m, y_m, str(direction))


def predicting(x_m: float, y_m: float) -> tuple[Value, ...]:
    """The first value of a prediction: where the ego will be."""
    return (its.point_values([[x_m, y_m]])[0],)


def expecting(expected: tuple[int, ...] | None, given: tuple[int, ...] | None) -> tuple[Decided, ...]:
    """The first value of a picture: what is expected of it, and its codes where they are given."""
    return (beside(expected, (None,) * PICTURE_CODES if given is None else given),)


def pictured(values: tuple[Value, ...]) -> NextPicture:
    """The picture that is imagined: every second code, see `beside`."""
    codes, camera = cast("tuple[tuple[int, ...], str]", values)
    return NextPicture(_CAMERAS[camera], tuple(codes[1::2]))


def _foreseen(values: Values) -> Foreseen:
    picture = pictured(values.all(its.VISUAL)) if its.VISUAL in values else None
    seen = perceived(values.all(its.PERCEPTION), values[its.THINK])
    return Foreseen(seen, *predicted(values.all(its.PREDICTION)), picture)


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
