"""`looktwice evaluate --outcomes`: what second looks bring, by what comes of plans that are followed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from looktwice.clients.metadrive.outcomes import (
    EpisodeSetting,
    FollowTask,
    Moment,
    MomentOutcomes,
    ReplayError,
    ResultStore,
    follow_unknown,
    outcome_store,
)
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.engines.engine import Controls, Draw, EngineError
from looktwice.model.evaluation.second_looks import FollowedDraw, OutcomeTable, outcome_table
from looktwice.model.evaluation.variants import Variant
from looktwice.service.cli.progress import progress_on_stderr

MOST_UNPAIRED: Final = 0.02
"""Of all draws: sums of a batch of another shape differ in their last bits, and now and then a word does."""

DrawsOf = Mapping[str, Sequence[Draw]]
"""The draws of a variant, by scene."""


@dataclass(frozen=True)
class Pair:
    """The two runs over the same scenes that are compared.

    Attributes:
        given: what of a scene the model is given beside pictures and history.
        never: the run that never thinks: its draws show what first plans lead to.
        adaptive: the run that thinks where it chooses to.
    """

    given: str
    never: Variant
    adaptive: Variant


def outcome_pairs(format: str, controls: Controls, inputs: Sequence[str]) -> list[Pair]:
    """The runs for a checkpoint that takes ``inputs``: with the route, and where it can with tracks too."""
    adaptive = replace(controls, thinking="adaptive")
    never = replace(controls, thinking="never", think_threshold=None)
    givens = [("route", False), ("route + tracks", True)]
    return [
        Pair(
            given,
            Variant(f"never thinks, {given}", format, never, route=True, tracks=tracks),
            Variant(f"adaptive, {given}", format, adaptive, route=True, tracks=tracks),
        )
        for given, tracks in (givens if "tracks" in inputs else givens[:1])
    ]


def followed_table(
    scenes: Sequence[LabelledScene],
    never: DrawsOf,
    adaptive: DrawsOf,
    setting: EpisodeSetting,
    workers: int,
    store: ResultStore[MomentOutcomes],
    on_scene: Callable[[], None] = lambda: None,
) -> OutcomeTable:
    """Follow the draws of both runs in every scene, and tell what second looks bring.

    Args:
        scenes: generated ones.
        never, adaptive: draws of both runs in all of them, made with the same seeds.
        setting: of the scenes' episodes.
        workers: processes.
        store: outcomes that are known; new ones are added.
        on_scene: called after each scene.

    Raises:
        EngineError: the runs do not begin with the same first plans.
        ReplayError: a scene's world cannot be made again.
        WorkerDied: a process died.
    """
    asked = {
        labelled.scene.scene_id: _asked(
            labelled, never[labelled.scene.scene_id], adaptive[labelled.scene.scene_id]
        )
        for labelled in scenes
    }
    found: dict[str, MomentOutcomes] = {}
    for scene_id, outcomes in follow_unknown(asked.values(), setting, workers, store):
        if isinstance(outcomes, str):
            raise ReplayError(outcomes)
        found[scene_id] = outcomes
        on_scene()
    draws: list[FollowedDraw | None] = []
    held = [labelled for labelled in scenes if found[labelled.scene.scene_id].expert.holds]
    for labelled in held:
        name = labelled.scene.scene_id
        draws += _draws(labelled.episode_id, never[name], adaptive[name], found[name])
    paired = [draw for draw in draws if draw is not None]
    unpaired = len(draws) - len(paired)
    if unpaired > MOST_UNPAIRED * len(draws):
        raise EngineError(
            f"{unpaired} of {len(draws)} draws begin with another plan when the engine never thinks: "
            "with the same seed they must not, and cannot be compared"
        )
    return outcome_table(paired, len(held), len(scenes) - len(held), unpaired)


def _asked(labelled: LabelledScene, never: Sequence[Draw], adaptive: Sequence[Draw]) -> FollowTask:
    """The trajectories of all first plans, then those of the second looks."""
    trajectories: list[FloatArray] = [draw.trajectory for draw in never]
    trajectories += [draw.trajectory for draw in adaptive if draw.looked_twice]
    return FollowTask(Moment.of(labelled), trajectories)


def _draws(
    episode_id: str, never: Sequence[Draw], adaptive: Sequence[Draw], found: MomentOutcomes
) -> Iterator[FollowedDraw | None]:
    """Draws with their outcomes; None for those whose runs do not begin with the same plan."""
    looks = iter(found.plans[len(never) :])
    for alone, draw, first in zip(never, adaptive, found.plans[: len(never)], strict=True):
        last = next(looks) if draw.looked_twice else first
        if alone.plan != draw.plan or draw.think_probability is None:
            yield None
        else:
            yield FollowedDraw(episode_id, draw.think_probability, first, draw.looked_twice, last)


def follow_pairs(
    pairs: Sequence[Pair],
    scenes: Sequence[LabelledScene],
    draws: Mapping[str, DrawsOf],
    setting: EpisodeSetting,
    workers: int,
    keep: Path | None,
    *,
    quiet: bool,
) -> dict[str, OutcomeTable]:
    """The tables of all pairs by what is given; ``draws`` by the variants' names.

    Raises as `followed_table` does.
    """
    store = outcome_store(keep)
    with progress_on_stderr(quiet=quiet) as progress:
        task = progress.add_task("plans followed", total=len(scenes) * len(pairs))

        def table(pair: Pair) -> OutcomeTable:
            never, adaptive = draws[pair.never.name], draws[pair.adaptive.name]
            return followed_table(
                scenes, never, adaptive, setting, workers, store, lambda: progress.advance(task)
            )

        return {pair.given: table(pair) for pair in pairs}
