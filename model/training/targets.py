"""What a response should say for a labelled scene, and how much each of its tokens weighs.

Loss is taken on assistant tokens only; weights come from section names, 1 : 10 : 10 for trajectory,
meta-actions and reasoning (CF-VLA sections 3.4 and 7); the first plan of a counterfactual example weighs 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Literal, get_args

from model.driving.direction import wanted_changes
from model.driving.plan import Plan
from model.families.cf_vla.format import ACTION, BRANCH, THINKING
from model.formats.cursor import CompiledFormat, Token
from model.formats.pieces import Values

SectionWeights = Mapping[str, float]

PAPER_WEIGHTS: Final[SectionWeights] = MappingProxyType(
    {"plan": 10.0, "branch": 10.0, "thinking": 10.0, "revised_plan": 10.0, "trajectory": 1.0}
)
"""w_act : w_meta : w_CF = 1 : 10 : 10 (CF-VLA section 7); the branch word counts as a meta-action token."""

Task = Literal["traj_only", "cf_vla"]
"""Formats that there are targets for."""


@dataclass(frozen=True)
class Reflection:
    """A counterfactual example's own parts: a plan of the model's own, and why it is to be corrected.

    ``thinking`` is empty where it is not: such a plan is acted on. ``revised_plan`` is what the reasoning
    leads to, where that is not the expert's plan in all tracks.
    """

    first_plan: Plan
    thinking: str
    revised_plan: Plan | None = None


@dataclass(frozen=True)
class Target:
    """A response to learn: token ids and the weight of each in the loss."""

    ids: tuple[int, ...]
    weights: tuple[float, ...]


def target_values(
    format: str, plan: Plan, codes: Sequence[int], reflection: Reflection | None = None
) -> Values:
    """The values of the response that an expert would give.

    Args:
        format: the response format's name, one of `Task`.
        plan: the expert's plan.
        codes: the expert's trajectory codes.
        reflection: makes it a counterfactual example: first the model's plan, then reasoning and ``plan``,
            or the trajectory at once.

    Raises:
        ValueError: nothing is known about what to say in this format.
    """
    trajectory = tuple(int(code) for code in codes)
    if format == "traj_only":
        return Values.of({"trajectory": trajectory})
    if format != "cf_vla":
        raise ValueError(f"no targets for format {format!r}; known are {', '.join(get_args(Task))}")
    if reflection is None:
        return Values.of({"plan": plan, BRANCH: ACTION, "trajectory": trajectory})
    if not reflection.thinking:
        return Values.of({"plan": reflection.first_plan, BRANCH: ACTION, "trajectory": trajectory})
    return Values.of(
        {
            "plan": reflection.first_plan,
            BRANCH: THINKING,
            "thinking": reflection.thinking,
            "revised_plan": reflection.revised_plan or plan,
            "trajectory": trajectory,
        }
    )


def weigh(tokens: Sequence[Token], weights: SectionWeights, *, counterfactual: bool = False) -> Target:
    """A rendered response with the weight of each token's section.

    Raises:
        KeyError: a section has no weight.
    """
    by_section = dict(weights)
    if counterfactual:
        by_section["plan"] = 0.0
    return Target(tuple(token.id for token in tokens), tuple(by_section[token.section] for token in tokens))


def make_target(
    compiled: CompiledFormat,
    plan: Plan,
    codes: Sequence[int],
    weights: SectionWeights = PAPER_WEIGHTS,
    reflection: Reflection | None = None,
) -> Target:
    """Render and weigh the expert's response in ``compiled``'s format.

    Where a reflection leads to a plan that the expert's trajectory does not carry out, the trajectory weighs
    nothing: it would teach to do otherwise than planned.

    Raises:
        ValueError: nothing is known about what to say in this format; a `FormatError` where it cannot say it.
    """
    values = target_values(compiled.format.name, plan, codes, reflection)
    # Plans of scenes without lanes lack a group, which the model by itself always writes.
    plans = {section: value for section in values if isinstance(value := values[section], Plan)}
    tokens = compiled.render(values, given=plans)
    revised = None if reflection is None else reflection.revised_plan
    if revised is not None and wanted_changes(revised, plan):
        weights = {**weights, "trajectory": 0.0}
    return weigh(tokens, weights, counterfactual=reflection is not None)
