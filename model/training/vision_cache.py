"""What a frozen tower sees in all examples, worked out once: an epoch then costs no tower.

The tokens lie in one file of float16, mapped into memory. The file's name tells tower, cameras and pictures
apart, so tokens of others are never taken; a count beside it lets a killed run go on.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch

from model.driving.hashing import hash_of
from model.driving.whole_files import written_whole
from model.network.checkpoint import Loaded
from model.network.patches import patchify
from model.network.precision import bfloat16_is_fast
from model.training.examples import Examples, example_frames

_BATCH: Final = 16
_VERSION: Final = 1

Tokens = npt.NDArray[np.float16]


class VisionCache:
    """Vision tokens of examples, and of their mirror images where they were asked for.

    Args:
        tokens: float16 [sides, n, v, hidden].
    """

    def __init__(self, tokens: Tokens) -> None:
        self._tokens = tokens

    @property
    def mirrored(self) -> bool:
        """Whether mirror images are there too."""
        return len(self._tokens) > 1

    def tokens(self, index: int, mirror: bool) -> Tokens:
        """Of one example, [v, hidden]; raises IndexError for a mirror image that is not there."""
        found: Tokens = self._tokens[int(mirror), index]
        return found


def open_vision(
    loaded: Loaded,
    examples: Examples,
    folder: Path,
    *,
    mirrored: bool,
    on_done: Callable[[int, int], None] | None = None,
) -> VisionCache:
    """The tokens that ``loaded``'s tower gives for examples; worked out where they are not there yet.

    Args:
        loaded: whose tower it is.
        examples: to look at.
        folder: where the file lies or goes.
        mirrored: look at mirror images too.
        on_done: told how many of how many pictures' scenes are done.
    """
    settings = loaded.settings
    text: Any = loaded.model.config.text_config
    sides, width = 1 + int(mirrored), text.hidden_size
    shape = (sides, len(examples), settings.vision_tokens, width)
    stem = f"vision-{_key(loaded, examples, sides)}"
    folder.mkdir(parents=True, exist_ok=True)
    path, count = folder / f"{stem}.f16", folder / f"{stem}.json"
    tokens = np.memmap(path, np.float16, "r+" if path.exists() else "w+", shape=shape)
    done = json.loads(count.read_text())["done"] if count.exists() else 0
    total = sides * len(examples)
    for start in range(done, total, _BATCH):
        places = range(start, min(start + _BATCH, total))
        patches = np.concatenate(
            [
                patchify(
                    example_frames(examples, place % len(examples), place >= len(examples), loaded.inputs),
                    settings,
                )
                for place in places
            ]
        )
        flat = tokens.reshape(total, *shape[2:])
        flat[places.start : places.stop] = _look(loaded, patches, len(places))
        if start // _BATCH % 50 == 0 or places.stop == total:
            tokens.flush()
            _write(count, places.stop)
        if on_done is not None:
            on_done(places.stop, total)
    return VisionCache(tokens)


@torch.inference_mode()
def _look(loaded: Loaded, patches: npt.NDArray[np.uint8], scenes: int) -> Tokens:
    settings = loaded.settings
    grid = torch.tensor([settings.grid] * (scenes * len(settings.cameras)))
    device = loaded.model.device
    with torch.autocast(device.type, torch.bfloat16, enabled=bfloat16_is_fast(device.type)):
        tokens = loaded.model.vision(torch.from_numpy(patches).to(device), grid)
    return tokens.view(scenes, settings.vision_tokens, -1).half().cpu().numpy()


def _key(loaded: Loaded, examples: Examples, sides: int) -> str:
    weights: dict[str, Any] = loaded.model.model.visual.state_dict()
    tower = [weights[name].float().cpu().numpy().tobytes() for name in sorted(weights)]
    settings = (loaded.settings.cameras, loaded.settings.grid)
    # Not by the names of scenes: two folders may have scenes of one name, with other pictures.
    pictures = hashlib.sha256(examples.pictures.data).digest()
    return hash_of(_VERSION, sides, settings, *tower, pictures, examples.picture_spans.tobytes())


def _write(path: Path, done: int) -> None:
    with written_whole(path) as temporary:
        temporary.write_text(json.dumps({"done": done}))
