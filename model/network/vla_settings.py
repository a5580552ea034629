"""What a LookTwice checkpoint knows beyond its backbone: cameras, picture size, formats, codec size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final, get_args

from looktwice.model.driving.facts import FACT_GROUPS
from looktwice.model.driving.phrases import ReflectionLanguage
from looktwice.model.driving.scene import CAMERAS, CLIP_FRAMES, CLIP_PERIOD_S, FRONT_TELE, FRONT_WIDE
from looktwice.model.families.registry import FROM_SCRATCH
from looktwice.model.families.trajectory_codes import CODES
from looktwice.model.network.intent import INTENT_TOKENS
from looktwice.model.network.second_sketch import VERDICT_TOKENS

SPOTTED: Final = {"pedestrian": 4, "vehicle": 6, "obstacle": 3}
"""How many of each kind the convolutions beside the tower tell of in a clip."""
CONFIG_KEY: Final = "looktwice"
"""Where these settings lie in a checkpoint's ``config.json``."""


class SettingsError(ValueError):
    """Settings that do not fit together; the text says which."""


@dataclass(frozen=True)
class VlaSettings:
    """Our part of a checkpoint's configuration.

    Attributes:
        name: the checkpoint's name, shown to users.
        formats: response formats it was trained on.
        reflection: what its reflections are written in (`Family.in_dialect`).
        cameras: cameras it looks at, in the order of the prompt.
        image_width, image_height: pixels that pictures are resized to; multiples of a merged patch.
        codec_size: trajectory codes per stage.
        with_route: whether it has a route encoder.
        with_tracks: whether it has a reader of tracks.
        sketch_tokens: of the prompt that tell the trajectory which a small planner's state amounts to
            (`looktwice.model.network.intent`); 0 for none.
        second_sketch: whether the prompt also tells what else might be driven, and a verdict
            (`looktwice.model.network.second_sketch`).
        fine_vision: whether convolutions look beside the tower (`looktwice.model.network.fine_vision`).
        scene_tokens: 0 where every vision token stands in the prompt, as in Qwen2.5-VL; otherwise a
            resampler brings those of all cameras down to so many.
        patch_size, temporal_patch_size, spatial_merge_size, tokens_per_second: as in the backbone's
            vision configuration.
    """

    name: str = "looktwice-nano"
    formats: tuple[str, ...] = FROM_SCRATCH
    reflection: ReflectionLanguage = "free_text"
    cameras: tuple[str, ...] = (FRONT_WIDE, FRONT_TELE)
    image_width: int = 224
    image_height: int = 112
    codec_size: int = 512
    with_route: bool = True
    with_tracks: bool = False
    sketch_tokens: int = 0
    second_sketch: bool = False
    fine_vision: bool = False
    scene_tokens: int = 0
    patch_size: int = 14
    temporal_patch_size: int = 2
    spatial_merge_size: int = 2
    tokens_per_second: int = 4

    def __post_init__(self) -> None:
        merged = self.patch_size * self.spatial_merge_size
        if self.image_width % merged or self.image_height % merged:
            raise SettingsError(
                f"image size {self.image_width}x{self.image_height} must be a multiple of {merged} pixels"
            )
        if CLIP_FRAMES % self.temporal_patch_size:
            raise SettingsError(f"temporal_patch_size {self.temporal_patch_size} must divide {CLIP_FRAMES}")
        if unknown := [camera for camera in self.cameras if camera not in CAMERAS]:
            raise SettingsError(f"unknown camera {', '.join(unknown)}; known are {', '.join(CAMERAS)}")
        if not 0 <= self.sketch_tokens <= CODES:
            raise SettingsError(f"sketch_tokens must lie in 0..{CODES}, got {self.sketch_tokens}")
        if self.second_sketch and not self.sketch_tokens:
            raise SettingsError("a second sketch stands beside a first one: sketch_tokens must not be 0")
        if self.fine_vision and (self.temporal_patch_size != CLIP_FRAMES or not self.scene_tokens):
            raise SettingsError(
                "convolutions beside the tower need whole clips as one slice, and a resampler: "
                f"temporal_patch_size must be {CLIP_FRAMES}, and scene_tokens not 0"
            )
        least = len(FACT_GROUPS) + self.intent_tokens
        if 0 < self.scene_tokens < least:
            raise SettingsError(
                f"scene_tokens must be 0 or at least {least}, got {self.scene_tokens}: "
                "every group of facts is read from a token of its own"
            )
        if self.reflection not in (languages := get_args(ReflectionLanguage)):
            raise SettingsError(
                f"unknown language of reflections {self.reflection!r}; known are {', '.join(languages)}"
            )
        if not self.cameras or not self.formats:
            raise SettingsError("a checkpoint needs at least one camera and one response format")

    @property
    def grid(self) -> tuple[int, int, int]:
        """Time slices, rows and columns of patches of one clip."""
        return (
            CLIP_FRAMES // self.temporal_patch_size,
            self.image_height // self.patch_size,
            self.image_width // self.patch_size,
        )

    @property
    def clip_tokens(self) -> int:
        """Vision tokens of one clip."""
        slices, rows, columns = self.grid
        return slices * rows * columns // self.spatial_merge_size**2

    @property
    def vision_tokens(self) -> int:
        """Vision tokens of all clips, those of convolutions among them."""
        return len(self.cameras) * (self.clip_tokens + self.fine_tokens)

    @property
    def tower_tokens(self) -> int:
        """Those of `vision_tokens` that the tower makes."""
        return len(self.cameras) * self.clip_tokens

    @property
    def fine_tokens(self) -> int:
        """Tokens of one clip that convolutions make."""
        return sum(SPOTTED.values()) if self.fine_vision else 0

    @property
    def intent_tokens(self) -> int:
        """Tokens that the state of a small planner becomes, with its sketches."""
        second = self.sketch_tokens + VERDICT_TOKENS if self.second_sketch else 0
        return INTENT_TOKENS + self.sketch_tokens + second

    @property
    def sketch_codes(self) -> int:
        """Trajectory codes that sketches are written in, of all their stages."""
        return self.sketch_tokens * self.codec_size

    @property
    def scene_queries(self) -> int:
        """Queries of the resampler: scene tokens but for those of the intent."""
        return max(0, self.scene_tokens - self.intent_tokens)

    @property
    def inputs(self) -> tuple[str, ...]:
        """What is taken of a scene beside pictures and history."""
        taken = {"route": self.with_route, "tracks": self.with_tracks}
        return tuple(name for name, is_taken in taken.items() if is_taken)

    @property
    def seconds_per_slice(self) -> float:
        """Seconds from one time slice of a clip to the next (1.0 with pairs of frames at 2 Hz)."""
        return CLIP_PERIOD_S * self.temporal_patch_size

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form for ``config.json``; what older checkpoints lack is not mentioned."""
        values = asdict(self)
        if self.reflection == "free_text":
            del values["reflection"]
        if not self.sketch_tokens:
            del values["sketch_tokens"]
        if not self.second_sketch:
            del values["second_sketch"]
        if not self.fine_vision:
            del values["fine_vision"]
        return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}

    @classmethod
    def of_config(cls, config: Any) -> VlaSettings:
        """The settings in a backbone's configuration, a `transformers` one; raises `SettingsError`."""
        extra = getattr(config, CONFIG_KEY, None)
        if not isinstance(extra, dict):
            raise SettingsError(f"its config.json has no {CONFIG_KEY!r}: expand a stock checkpoint first")
        return cls.from_dict({key: value for key, value in extra.items() if not key.endswith("_token_id")})

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> VlaSettings:
        """The inverse of `to_dict`; raises `SettingsError` for unknown or unfitting entries."""
        try:
            fields: dict[str, Any] = {
                key: tuple(value) if isinstance(value, list) else value for key, value in values.items()
            }
            return cls(**fields)
        except TypeError as error:
            raise SettingsError(f"not LookTwice settings: {error}") from error


NANO_SETTINGS: Final = VlaSettings(
    reflection="phrases",
    image_width=336,
    image_height=168,
    temporal_patch_size=4,
    with_tracks=True,
    sketch_tokens=4,
    scene_tokens=22,
)
"""Of the model that is trained from scratch: motion is seen within one patch, over all four frames."""
EXPANDED_SETTINGS: Final = VlaSettings(image_width=336, image_height=168)
"""Of a backbone that can write: free text, and all its vision tokens in the prompt, as in the paper."""
