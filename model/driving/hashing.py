"""Names for what was asked, so that an answer to it can be found again."""

from __future__ import annotations

import hashlib
import json

from model.driving.scene import Scene


def hash_of(*parts: object) -> str:
    """32 hex digits that stand for parts: bytes as they are, all else as JSON."""
    digest = hashlib.sha256()
    for part in parts:
        content = part if isinstance(part, bytes) else json.dumps(part, sort_keys=True).encode()
        digest.update(len(content).to_bytes(8, "big") + content)
    return digest.hexdigest()[:32]


def scene_hash(scene: Scene) -> str:
    """Stands for a scene with its name, its pictures, its way, behind and ahead, and its tracks."""
    arrays = (scene.history, *(() if scene.route is None else (scene.route,)))
    pictures = [picture for clip in scene.clips for picture in (clip.camera.encode(), *clip.images)]
    tracks = () if scene.tracks is None else ([vars(t) | {"lights": sorted(t.lights)} for t in scene.tracks],)
    return hash_of(scene.scene_id, *pictures, *(array.tobytes() for array in arrays), *tracks)
