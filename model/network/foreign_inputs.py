"""A scene as a foreign checkpoint's inputs: by its own chat template, tokenizer and picture processor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from threading import Lock
from typing import Any

from torch import Tensor

from looktwice.model.driving.scene import Scene
from looktwice.model.families.family import Attempt, Family, Situation
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.network.foreign_prompt import Part, prompt_parts
from looktwice.model.network.foreign_vocabulary import ForeignVocabulary


class ForeignInputBuilder:
    """Builds inputs for one foreign checkpoint. Safe to use from several threads.

    Args:
        processor: of pictures and texts; the tokenizer where the checkpoint reads text alone.
        vocabulary: of its tokenizer.
        families: that it is to write.
        cameras: whose pictures it is shown.

    Raises:
        FormatError: a family says of scenes what this tokenizer cannot spell.
    """

    def __init__(
        self,
        processor: Any,
        vocabulary: ForeignVocabulary,
        families: Mapping[str, Family],
        cameras: Sequence[str],
    ) -> None:
        self._processor, self._vocabulary, self._cameras = processor, vocabulary, cameras
        self._own_texts = {
            name: CompiledFormat(family.inputs.format, vocabulary)
            for name, family in families.items()
            if family.inputs is not None
        }
        # Tokenizers keep a state while they work.
        self._lock = Lock()

    @property
    def chat_template(self) -> Any:
        """By which the checkpoint is asked; None where it has none."""
        return getattr(self._processor, "chat_template", None)

    def build(self, scene: Scene, family: Family, attempt: Attempt | None = None) -> dict[str, Tensor]:
        """The prompt of a scene as the network's `forward` takes it, with a batch of one.

        Raises:
            SceneError: a camera is missing.
            ImageError: a picture cannot be decoded.
            FamilyError, FormatError: the family says of the scene what its prompt cannot say.
            ValueError: the prompt would hold one of the tokenizer's own markers.
        """
        own_text = self._own_text(scene, family, attempt)
        parts = list(prompt_parts(scene, family, own_text, self._cameras))
        for marker in self._vocabulary.special:
            if any(isinstance(part, str) and marker in part for part in parts):
                raise ValueError(f"the prompt must not hold {marker!r}, which is a marker of this checkpoint")
        with self._lock:
            return dict(self._processed(parts))

    def _own_text(self, scene: Scene, family: Family, attempt: Attempt | None) -> str:
        """What a family says of a scene itself."""
        if family.inputs is None:
            return ""
        values = family.inputs.values(Situation(scene.history, scene.route, attempt))
        tokens = self._own_texts[family.name].render(values)
        return self._vocabulary.decode(token.id for token in tokens)

    def _processed(self, parts: Sequence[Part]) -> Any:
        pictures = [part for part in parts if not isinstance(part, str)]
        text = "".join(part for part in parts if isinstance(part, str))
        if self.chat_template is None:
            return self._processor(text, return_tensors="pt")
        content = [
            {"type": "text", "text": each} if isinstance(each, str) else {"type": "image"} for each in parts
        ]
        message = {"role": "user", "content": content if pictures else text}
        asked = self._processor.apply_chat_template([message], tokenize=False, add_generation_prompt=True)
        # The template writes all markers, the one of the beginning too.
        settings = {"add_special_tokens": False, "return_tensors": "pt"}
        if pictures:
            return self._processor(text=[asked], images=[pictures], **settings)
        return self._processor(asked, **settings)
