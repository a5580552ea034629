"""What a response should say for a labelled scene, and how much each of its tokens weighs.

Loss is taken on assistant tokens only; weights come from section names (CF-VLA sections 3.4 and 7). The
first plan of a counterfactual example weighs 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from looktwice.model.driving.direction import wanted_changes
from looktwice.model.driving.plan import Plan
from looktwice.model.families.family import Family, Lesson
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.formats.replay import decisions

SectionWeights = Mapping[str, float]


@dataclass(frozen=True)
class Target:
    """A response to learn: token ids and the weight of each in the loss."""

    ids: tuple[int, ...]
    weights: tuple[float, ...]


def make_target(
    family: Family,
    compiled: CompiledFormat,
    lesson: Lesson,
    weights: SectionWeights,
    *,
    expert_branches: bool = True,
) -> Target:
    """Render and weigh the response that a lesson teaches, in ``compiled``, the family's format.

    Where a reflection leads to a plan that the expert's trajectory does not carry out, the trajectory weighs
    nothing: it would teach to do otherwise than planned.

    A reflection makes it a counterfactual example: first the model's plan, then reasoning and the expert's,
    or the trajectory at once.

    Args:
        weights: by section.
        expert_branches: whether the expert's own response teaches the branch. Where reflections say which of
            the model's plans fail, it would only say that nothing fails in hard scenes either.

    Raises:
        ValueError: the family does not say what to teach; a `FormatError` where its format cannot say it.
        KeyError: a section has no weight.
    """
    if family.teach is None:
        raise ValueError(f"no targets for format {family.name!r}: its family teaches nothing")
    values = family.teach(lesson)
    # Plans of scenes without lanes lack a group, which the model by itself always writes.
    plans = {section: each for section in values for each in values.all(section) if isinstance(each, Plan)}
    tokens = compiled.render(values, given=plans)
    untaught, reflection = set[str | None](), lesson.reflection
    judged = expert_branches if reflection is None else reflection.judged
    if not judged and family.branch is not None:
        untaught.add(family.branch.name)
    if reflection is not None:
        untaught.add(family.first_plan)
        if reflection.revised_plan is not None and wanted_changes(reflection.revised_plan, lesson.plan):
            untaught.add(family.trajectory)
    taught = {section: 0.0 if section in untaught else weight for section, weight in weights.items()}
    ids, given = tuple(token.id for token in tokens), set[int]()
    if family.imagination is not None and family.imagination.section in values:
        fixed = family.imagination.fixed_values(lesson.expected)
        made = {decision.position for decision in decisions(compiled.start(plans, fixed=fixed), ids)}
        given = {place for place, token in enumerate(tokens) if token.section in fixed and place not in made}
    weighed = (0.0 if place in given else taught[token.section] for place, token in enumerate(tokens))
    return Target(ids, tuple(weighed))
