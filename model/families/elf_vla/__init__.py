"""ELF-VLA: thinks in the order of its prompt, then gives eight poses; refines a draft by feedback."""

from typing import Final

from looktwice.model.families.elf_vla import format as its
from looktwice.model.families.elf_vla.inputs import BASE, WITH_ATTEMPT
from looktwice.model.families.elf_vla.read import read
from looktwice.model.families.elf_vla.targets import teach
from looktwice.model.families.family import Family, TextInputs

_TASK: Final = (
    "First think within <think> </think>: is the car close to a road boundary; which agents may affect it; "
    "what does it do next. Then, based strictly on this behavior, give the trajectory within "
    "<answer> </answer>: exactly 8 waypoints in the format [x, y, heading]."
)
"""Figure 6, shortened."""


def _family(name: str, task: str, inputs: TextInputs, title: str, about: str, *, refines: bool) -> Family:
    return Family(
        format=its.free_text(name),
        dialects={"phrases": its.phrases(name)},
        task=task,
        inputs=inputs,
        trajectory=its.ANSWER,
        reflection=its.THINK,
        read=read,
        times_s=its.TIMES_S,
        teach=teach,
        lesson_needs=("thoughts",),
        title=title,
        about=about,
        refines=refines,
    )


ELF_VLA: Final = _family(
    "elf_vla",
    _TASK,
    BASE,
    "think-answer",
    "says what matters around the car and what it does next, and gives eight poses over 4 s",
    refines=False,
)
"""think, answer"""

ELF_VLA_REFINE: Final = _family(
    "elf_vla_refine",
    f"{_TASK} Refine the draft by the feedback on it.",
    WITH_ATTEMPT,
    "refine-answer",
    "refines a draft of eight poses by feedback on it",
    refines=True,
)
"""The same, with a draft and feedback on it in the prompt."""
