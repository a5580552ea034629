"""The text around the pictures: Qwen's chat layout, our own words."""

from __future__ import annotations

from typing import Final

from looktwice.model.families.registry import family_named
from looktwice.model.network.vla_settings import VlaSettings
from looktwice.model.network.vocabulary import (
    HISTORY,
    HISTORY_END,
    HISTORY_START,
    IM_END,
    IM_START,
    ROUTE,
    ROUTE_END,
    ROUTE_START,
    TRACK,
    TRACKS_END,
    TRACKS_START,
    VIDEO_PAD,
    VISION_END,
    VISION_START,
)

SYSTEM: Final = "You plan how this car drives."
"""What the model is told it is."""


def prompt_text(format: str, settings: VlaSettings, *, route: bool, tracks: bool = False) -> tuple[str, str]:
    """The whole prompt, placeholders included, up to where the response begins: in two parts.

    What all scenes share comes first and the history after the pictures, so that caches of common
    beginnings hold as long as possible. A family's own text inputs stand between the parts.

    Args:
        format: the response format's name; its family decides the task.
        settings: cameras, in their order, and the number of placeholders.
        route: whether the scene has a route.
        tracks: whether it has tracks.

    Raises:
        FamilyError: there is no such format.
    """
    return (
        f"{IM_START}system\n{SYSTEM}{IM_END}\n"
        f"{IM_START}user\n{family_named(format).task}\n"
        f"{_seen(settings)}"
        f"{motion_text(settings, route=route, tracks=tracks)}",
        f"{IM_END}\n{IM_START}assistant\n",
    )


def chat_template(settings: VlaSettings) -> str:
    """The same prompt as a template for `apply_chat_template`.

    A message's content is text or a list of ``text``, ``video`` (all clips together, in the checkpoint's
    order of cameras), ``history``, ``route`` and ``tracks``; the task comes first.
    """
    history = motion_text(settings, route=False)
    written = {
        "video": _seen(settings),
        "history": history,
        "route": motion_text(settings, route=True).removeprefix(history),
        "tracks": motion_text(settings, route=False, tracks=True).removeprefix(history),
    }
    parts = "".join(f"{{% elif part.type == {kind!r} %}}{{{{ {text!r} }}}}" for kind, text in written.items())
    return (
        "{% if messages[0].role != 'system' %}"
        f"{{{{ {f'{IM_START}system{chr(10)}{SYSTEM}{IM_END}{chr(10)}'!r} }}}}"
        "{% endif %}"
        "{% for message in messages %}"
        f"{{{{ {IM_START!r} + message.role + '\\n' }}}}"
        "{% if message.content is string %}{{ message.content }}{% else %}"
        "{% for part in message.content %}"
        "{% if part.type == 'text' %}{{ part.text + '\\n' }}"
        f"{parts}"
        "{% endif %}{% endfor %}{% endif %}"
        f"{{{{ {f'{IM_END}{chr(10)}'!r} }}}}"
        "{% endfor %}"
        f"{{% if add_generation_prompt %}}{{{{ {f'{IM_START}assistant{chr(10)}'!r} }}}}{{% endif %}}"
    )


def _seen(settings: VlaSettings) -> str:
    if settings.scene_tokens:
        return f"cameras:{VISION_START}{VIDEO_PAD * settings.scene_tokens}{VISION_END}\n"
    clip = f"{VISION_START}{VIDEO_PAD * settings.clip_tokens}{VISION_END}"
    return "".join(f"{camera}:{clip}\n" for camera in settings.cameras)


def motion_text(settings: VlaSettings, *, route: bool, tracks: bool = False) -> str:
    """The prompt's lines about the ego's motion and that of tracks: all there is without pictures."""
    way = f"route:{ROUTE_START}{ROUTE}{ROUTE_END}\n" if route else ""
    around = f"tracks:{TRACKS_START}{TRACK * settings.intent_tokens}{TRACKS_END}\n" if tracks else ""
    return f"history:{HISTORY_START}{HISTORY}{HISTORY_END}\n{way}{around}"
