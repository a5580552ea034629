"""Recipes: the stages of learning with everything that decides their outcome (CF-VLA sections 3.4 and 7).

The paper trains a pretrained 3B model; a model from scratch on a small budget needs its stages in this
order: ``language`` (history and plan language, no pictures), ``ground`` (the vision tower alone), then
``traj-only`` and ``meta-act`` with pictures.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal

from looktwice.model.driving.pdm.comfort import Version
from looktwice.model.driving.pdm.judged import THRESHOLD
from looktwice.model.engines.engine import Decision
from looktwice.model.families.cf_vla.targets import (
    CODE_WEIGHTS,
    NANO_WEIGHTS,
    PAPER_WEIGHTS,
    SKETCHED_WEIGHTS,
)
from looktwice.model.families.elf_vla import targets as elf_vla
from looktwice.model.families.registry import family_named
from looktwice.model.families.vla_world import targets as vla_world
from looktwice.model.families.vla_world.rewards import REWARDS as VLA_WORLD_REWARDS
from looktwice.model.training.outcome.draw_rewards import RewardWeights
from looktwice.model.training.response_targets import SectionWeights

Goal = Literal["ground", "fine", "facts", "read", "judge", "respond", "outcome", "code"]
FeedbackWriter = Literal["teacher", "rule"]


@dataclass(frozen=True)
class RefineSettings:
    """How a network's own refinements are learned from as first answers; see
    `looktwice.model.training.outcome.outcome_learner`.

    Attributes:
        format: that it refines in; what it writes there must be an answer in the format of its draws.
        threshold: scenes are refined whose worst draw scores less.
        feedback: the ``teacher``'s five sections, or the verdict by ``rule`` with what the expert did, which
            ELF-VLA compares with as Rule-GRPO (section 9.1).
        count: refinements of a scene.
        gamma: of the weight that their decisions have, see `policy_loss`.
    """

    format: str
    threshold: float = THRESHOLD
    feedback: FeedbackWriter = "teacher"
    count: int = 1
    gamma: float = 0.1


@dataclass(frozen=True)
class OutcomeSettings:
    """How a network learns from what comes of its own draws; see `looktwice.model.training.outcome`.

    Attributes:
        draws: of each scene, compared with each other.
        temperature: that they are drawn at.
        updates: that the draws of a batch of scenes serve before new ones are made.
        clip: see `policy_loss`.
        numbers: how numbers that are one token each are chosen; digits are drawn as words are.
        codes: how codes are chosen. Numbers and codes of least expected error are no draws, and nothing is
            learned from how they turned out.
        imitation: weight of the loss on the expert's responses, beside that of the draws.
        rewards: what counts: what comes of draws, or the rewards of their family by name, with weights.
        version: whose rules score draws.
        normalised: see `advantages`.
        divergence: weight of the `divergence` from the network that training began with.
        refining: what becomes of scenes whose draws all fail; None for nothing.
    """

    draws: int = 8
    temperature: float = 1.0
    numbers: Decision = "drawn"
    codes: Decision = "least_error"
    updates: int = 1
    clip: float = 0.2
    imitation: float = 0.01
    rewards: RewardWeights | Mapping[str, float] = field(default_factory=RewardWeights)
    version: Version = "v2.2"
    normalised: bool = False
    divergence: float = 0.0
    refining: RefineSettings | None = None


@dataclass(frozen=True)
class Recipe:
    """One stage.

    Attributes:
        name: as the command line gives it.
        goal: ``ground`` trains the vision tower alone, ``fine`` the convolutions beside a frozen one,
            ``facts`` the reading of what is seen, ``read`` what to do about tracks or, with pictures, about
            what was gathered from them, ``judge`` what comes of trajectories, ``respond`` trains everything
            on responses, ``outcome`` on what comes of own draws, ``code`` the codes of pictures alone.
        pictures: whether responses are learned with pictures.
        tasks: share of the examples for each response format.
        route_share: share of the examples whose route is given.
        weights: of sections in the loss.
        steps, batch_size: how long; of ``outcome``, scenes are counted, each with all its draws.
        learning_rate, warmup_steps: cosine decay to zero behind a linear warm-up.
        vision_rate: the tower's learning rate, relative to the rest; 0 leaves the tower as it is.
        misread_share: share of the examples without pictures that are misread as pictures would be; the facts
            of all others are taken as they are, so that what is read later is trusted.
        tracks_share, mirror_share, blur_share: shares of the examples with tracks, mirrored, and with no
            history but the present speed; see `Item`.
        picture_share: share of the examples with pictures half a second ahead that are taught one of them.
        own_plans: learn trajectories behind plans of the model's own too, where it has small planners to draw
            them from, see `OwnPlans`.
        sketched: plans and trajectories are those of the sketch in the prompt, not the expert's: what is
            to be copied has no noise to be learned by heart.
        error_weight: nats that a metre of a code's expected error counts.
        head_weight: of a regression of the trajectory where its first code is written.
        reflections: what becomes of the reflections of a build: ``learned`` as counterfactual examples, or
            their ``scenes`` learned once more without them; None where there are none.
        attempting: the format in which a model's own failures are learned from, where there is a file of
            them; None where they are not.
        outcome: how own draws are judged; for that goal alone.
        seed: of order and initialisation.
        weight_decay: of AdamW.
    """

    name: str
    goal: Goal
    steps: int
    batch_size: int
    learning_rate: float
    warmup_steps: int
    pictures: bool = True
    tasks: Mapping[str, float] = field(default_factory=dict)
    route_share: float = 0.5
    weights: SectionWeights = field(default_factory=lambda: PAPER_WEIGHTS)
    vision_rate: float = 1.0
    misread_share: float = 1.0
    tracks_share: float = 0.0
    mirror_share: float = 0.0
    blur_share: float = 0.0
    picture_share: float = 0.0
    own_plans: bool = False
    sketched: bool = False
    error_weight: float = 0.0
    head_weight: float = 0.0
    reflections: Literal["learned", "scenes"] | None = None
    attempting: str | None = None
    outcome: OutcomeSettings | None = None
    seed: int = 0
    weight_decay: float = 0.01


def _with_control(*recipes: Recipe) -> tuple[Recipe, ...]:
    """Recipes, and the last one's control: its reflections' scenes once more, without the reflections."""
    return (*recipes, replace(recipes[-1], name="multi-round", reflections="scenes"))


_NANO: Final = Recipe(
    "nano",
    "respond",
    steps=6000,
    batch_size=32,
    learning_rate=5e-4,
    warmup_steps=200,
    tasks={"traj_only": 0.25, "cf_vla": 0.75},
    route_share=0.85,
    weights=NANO_WEIGHTS,
    # The tower sees well once it is grounded; frozen, it is asked once for all epochs.
    vision_rate=0.0,
    tracks_share=0.5,
    mirror_share=0.5,
    blur_share=0.15,
    error_weight=0.5,
    head_weight=0.25,
)

_OUTCOME: Final = replace(
    _NANO,
    goal="outcome",
    steps=400,
    learning_rate=2e-5,
    warmup_steps=10,
    mirror_share=0.0,
    blur_share=0.0,
    head_weight=0.0,
)

VISUAL_CODES: Final = Recipe(
    "visual-codes", "code", steps=6000, batch_size=16, learning_rate=1e-3, warmup_steps=200
)
"""Of the codes of pictures, which start from nothing; see `looktwice.model.training.visual_codes`."""

COMPOSER: Final = Recipe("composer", "code", steps=4000, batch_size=16, learning_rate=1e-3, warmup_steps=200)
"""Of what composes pictures of codes and of what was seen; see `looktwice.model.training.composer`."""

_READ: Final = Recipe(
    "read",
    "read",
    steps=6000,
    batch_size=256,
    learning_rate=1e-3,
    warmup_steps=200,
    route_share=0.85,
    vision_rate=0.0,
    mirror_share=0.5,
)

_COUNTERFACTUAL: Final = replace(
    _NANO,
    name="counterfactual",
    steps=3000,
    learning_rate=2.5e-4,
    reflections="learned",
    own_plans=True,
)

NANO: Final[Mapping[str, Recipe]] = (
    {
        recipe.name: recipe
        for recipe in _with_control(
            replace(
                _NANO,
                name="language",
                batch_size=64,
                learning_rate=1e-3,
                pictures=False,
                tasks={"traj_only": 0.65, "cf_vla": 0.35},
                tracks_share=0.75,
            ),
            Recipe("ground", "ground", steps=6000, batch_size=24, learning_rate=1e-3, warmup_steps=200),
            replace(_READ, name="fine-vision", goal="fine", steps=3000, batch_size=32),
            replace(_READ, name="read-facts", goal="facts", steps=2000, batch_size=64, learning_rate=3e-4),
            replace(_READ, name="read-tracks", pictures=False, steps=6000, batch_size=256),
            replace(_READ, name="read-scene", steps=4000, batch_size=64),
            replace(_READ, name="critic", goal="judge", steps=4000),
            replace(_NANO, name="traj-only", steps=3000, tasks={"traj_only": 1.0}),
            replace(_NANO, name="meta-act"),
            _COUNTERFACTUAL,
        )
    }
    | {
        # Without trajectory codes there is neither their error to learn from, nor the head beside them.
        name: replace(
            _NANO,
            name=name,
            tasks={task: 1.0},
            weights=weights,
            picture_share=picture_share,
            error_weight=0.0,
            head_weight=0.0,
            attempting=attempting,
        )
        for name, task, weights, picture_share, attempting in (
            ("elf-pretrain", "elf_vla", elf_vla.QUESTION_WEIGHTS, 0.0, None),
            ("elf-sft", "elf_vla", elf_vla.WEIGHTS, 0.0, "elf_vla_refine"),
            ("world-pretrain", "vla_world", vla_world.PICTURE_WEIGHTS, 1.0, None),
            ("world-sft", "vla_world", vla_world.WEIGHTS, 0.5, None),
        )
    }
    | {
        "sketched": replace(
            _COUNTERFACTUAL,
            name="sketched",
            steps=1500,
            learning_rate=3e-4,
            sketched=True,
            weights=SKETCHED_WEIGHTS,
            head_weight=0.0,  # a head that starts from nothing drowns what little there is to learn
            blur_share=0.0,  # the prompt of a blurred history sketches otherwise
        ),
        "cf-rl": replace(
            _OUTCOME,
            name="cf-rl",
            batch_size=16,
            tasks={"cf_vla": 1.0},
            # The expert's words lead to no second look: learned beside, they would end all of them.
            weights=CODE_WEIGHTS,
            outcome=OutcomeSettings(codes="drawn", imitation=0.05),
        ),
        # Section 9.1 and table 7; parts of the reward count alike, of which the supplement says nothing.
        "elf-rl": replace(
            _OUTCOME,
            name="elf-rl",
            batch_size=8,
            tasks={"elf_vla": 1.0},
            route_share=1.0,  # the paper's prompts always say where to go
            weights=elf_vla.WEIGHTS,
            error_weight=0.0,
            outcome=OutcomeSettings(
                temperature=1.2,
                updates=2,  # "2 iterations", as implementations of GRPO call them
                rewards=RewardWeights(
                    outcome=1.0, imitation=0.0, words=0.0, thinking=0.0, goal=1.0, form=1.0
                ),
                version="v1.1",
                refining=RefineSettings("elf_vla_refine"),
            ),
        ),
        # Appendix A.1; the paper gives no weights of the rewards.
        "world-rl": replace(
            _OUTCOME,
            name="world-rl",
            batch_size=4,  # of 8 responses with hundreds of tokens each: more need over 16 GB
            tasks={"vla_world": 1.0},
            weights=vla_world.WEIGHTS,
            error_weight=0.0,
            outcome=OutcomeSettings(
                codes="drawn",
                rewards=dict.fromkeys(VLA_WORLD_REWARDS, 1.0),
                normalised=True,
                divergence=0.01,
            ),
        ),
    }
)
"""The stages of the shipped checkpoint, the control of its last one, those of ELF-VLA and of VLA-World, and
outcome training."""


RESPOND: Final = "respond"
"""The recipe of a format that is named beside it; see `responding`."""


def lasting(recipe: Recipe, steps: int) -> Recipe:
    """A recipe of so many steps; a shorter one warms up for less of them, in proportion."""
    return replace(
        recipe,
        steps=steps,
        warmup_steps=min(recipe.warmup_steps, recipe.warmup_steps * steps // recipe.steps),
    )


def responding(format_name: str, weights: SectionWeights) -> Recipe:
    """A recipe that teaches responses of one format, of any family; sections without a weight weigh 1.

    Raises:
        FamilyError: nobody declares the format.
        ValueError: it has no such section, or its family does not say what scenes teach.
    """
    family = family_named(format_name)
    if family.teach is None or family.refines:
        raise ValueError(f"scenes alone teach no responses in format {format_name!r}")
    sections = family.format.sections()
    if unknown := [section for section in weights if section not in sections]:
        raise ValueError(
            f"format {format_name!r} has no section {unknown[0]!r}; it has {', '.join(sections)}"
        )
    return replace(
        NANO["elf-sft"],
        name=RESPOND,
        tasks={format_name: 1.0},
        weights=dict.fromkeys(sections, 1.0) | dict(weights),
        attempting=None,
    )


def refining_with(recipe: Recipe, **changes: Any) -> Recipe:
    """A recipe with other `RefineSettings`, such as a ``threshold`` of 0, below which nothing is refined.

    Raises:
        ValueError: it refines nothing.
    """
    outcome = recipe.outcome
    if outcome is None or outcome.refining is None:
        raise ValueError(f"recipe {recipe.name} refines no draws")
    refining = replace(outcome.refining, **changes)
    return replace(recipe, outcome=replace(outcome, refining=refining))


_PAPER: Final = Recipe(
    "paper",
    "respond",
    steps=300_000,
    batch_size=1,
    learning_rate=1e-5,
    warmup_steps=2000,
    tasks={"traj_only": 0.5, "cf_vla": 0.5},
)

_PAPER_ELF: Final = Recipe(
    "paper-elf",
    "respond",
    # Two epochs of NAVSIM's 103,000 scenes on 16 devices. The paper pre-trains on other data as well, and
    # does not say on how much.
    steps=3220,
    batch_size=4,
    learning_rate=1e-5,
    warmup_steps=161,  # "0.05 weight ratio": taken for the share of the steps that warm up
    tasks={"elf_vla": 1.0},
    route_share=1.0,
    weights=elf_vla.WEIGHTS,
    weight_decay=0.05,
)
"""Table 7 of ELF-VLA's supplement."""

PAPER: Final[Mapping[str, Recipe]] = {
    recipe.name: recipe
    for recipe in (
        *_with_control(
            replace(_PAPER, name="traj-only", tasks={"traj_only": 1.0}),
            replace(_PAPER, name="meta-act"),
            replace(_PAPER, name="counterfactual", learning_rate=5e-6, reflections="learned"),
        ),
        replace(_PAPER_ELF, name="elf-pretrain", weights=elf_vla.QUESTION_WEIGHTS),
        replace(_PAPER_ELF, name="elf-sft", learning_rate=4e-5, attempting="elf_vla_refine"),
        replace(
            _PAPER_ELF,
            name="elf-rl",
            goal="outcome",
            steps=134,
            batch_size=48,
            learning_rate=2e-6,
            warmup_steps=7,
            outcome=NANO["elf-rl"].outcome,
        ),
    )
}
"""The stages of both papers for a pretrained backbone. The batch is per device: CF-VLA has 64, ELF-VLA
16, and its `elf-rl` 32. It is as large as what ELF-VLA accumulates."""
