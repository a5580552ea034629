"""What a response should say for a labelled scene, and how much each of its tokens weighs.

Loss is taken on assistant tokens only; weights come from section names (CF-VLA sections 3.4 and 7). The
first plan of a counterfactual example weighs 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from model.driving.direction import wanted_changes
from model.driving.plan import Plan
from model.families.family import Family, Lesson, Reflection
from model.formats.cursor import CompiledFormat

SectionWeights = Mapping[str, float]


@dataclass(frozen=True)
class Target:
    """A response to learn: token ids and the weight of each in the loss."""

    ids: tuple[int, ...]
    weights: tuple[float, ...]


def make_target(
    family: Family,
    compiled: CompiledFormat,
    plan: Plan,
    codes: Sequence[int],
    weights: SectionWeights,
    reflection: Reflection | None = None,
) -> Target:
    """Render and weigh the expert's response in ``compiled``, the family's format.

    Where a reflection leads to a plan that the expert's trajectory does not carry out, the trajectory weighs
    nothing: it would teach to do otherwise than planned.

    Args:
        plan, codes: the expert's plan and trajectory codes.
        weights: by section.
        reflection: makes it a counterfactual example: first the model's plan, then reasoning and ``plan``,
            or the trajectory at once.

    Raises:
        ValueError: the family does not say what to teach; a `FormatError` where its format cannot say it.
        KeyError: a section has no weight.
    """
    if family.teach is None:
        raise ValueError(f"no targets for format {family.name!r}: its family teaches nothing")
    values = family.teach(Lesson(plan, tuple(map(int, codes)), reflection))
    # Plans of scenes without lanes lack a group, which the model by itself always writes.
    plans = {section: value for section in values if isinstance(value := values[section], Plan)}
    tokens = compiled.render(values, given=plans)
    untaught: set[str | None] = set()
    if reflection is not None:
        untaught.add(family.first_plan)
        if not reflection.judged and family.branch is not None:
            untaught.add(family.branch.name)
        if reflection.revised_plan is not None and wanted_changes(reflection.revised_plan, plan):
            untaught.add(family.trajectory)
    taught = {section: 0.0 if section in untaught else weight for section, weight in weights.items()}
    return Target(tuple(token.id for token in tokens), tuple(taught[token.section] for token in tokens))
