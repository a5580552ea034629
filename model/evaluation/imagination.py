"""What imagination brings: a checkpoint with a picture, without one, and with pictures of other scenes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from typing import Any, Final

import numpy as np

from looktwice.model.driving.columns import Columns, aligned, cell
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.trajectory import TEN_HZ_S
from looktwice.model.engines.engine import Controls, Draw, Engine
from looktwice.model.evaluation.bootstrap import Comparison, compare
from looktwice.model.evaluation.entering import EnteringResult, evaluate_entering
from looktwice.model.evaluation.figures import FigureRow, figure_table
from looktwice.model.evaluation.next_frames import (
    NextFrameResults,
    Painter,
    TowerFeatures,
    copied,
    imagined_codes,
    measure_pictures,
    through_codes,
    warped,
    what_came,
)
from looktwice.model.evaluation.open_loop import BASELINES, SceneResult
from looktwice.model.evaluation.protocols import Protocol
from looktwice.model.evaluation.report import evaluate_variants
from looktwice.model.evaluation.table import comparison_cells
from looktwice.model.evaluation.variants import Variant, donors, next_camera, request_for
from looktwice.model.evaluation.waypoints import (
    PROTOCOLS,
    WAYPOINT_MEASURES,
    ActionScore,
    WaypointResult,
    WaypointScene,
    action_scores,
    waypoints_of,
)
from looktwice.model.families.family import Family
from looktwice.model.families.registry import family_named
from looktwice.model.network.checkpoint import Loaded
from looktwice.model.network.model_card import ModelCard
from looktwice.model.network.visual_codes import Frame

AUTO: Final = "auto"
NEVER: Final = "never"
ALWAYS: Final = "always"
ASKED: Final = "always, camera asked for"
SHUFFLED: Final = f"{ASKED}, shuffled images"
UNTHINKING: Final = f"{ASKED}, thinks of nobody"
GIVEN_CAME: Final = f"{ASKED}, given what came"
GIVEN_UNCHANGED: Final = f"{ASKED}, given the last frame, moved"
GIVEN_OTHER: Final = f"{ASKED}, given another scene's"
COPIED: Final = "the last frame"
WARPED: Final = "the last frame, moved as the ego"
UNCHANGED: Final = f"{WARPED}, through its codes"
CODED: Final = "what came, through its codes"

_SHOWN: Final = 8
"""Scenes whose pictures are shown."""
_PICTURE_MEASURES: Final = ("psnr_db", "feature_distance")


def imagination_variants(
    loaded: Loaded, scenes: Sequence[LabelledScene], controls: Controls
) -> list[Variant]:
    """The rows of a checkpoint that imagines; the route is given, as it says the mission goal.

    Args:
        loaded: the checkpoint.
        scenes: that it is evaluated on; rows that are given another scene's picture take it from them.
        controls: of all rows, but for what they differ in.

    Raises:
        ValueError: see `imagining`.
    """
    family = imagining(loaded.card)
    codes = loaded.visual_codes
    assert codes is not None, "a checkpoint that paints has them"

    @cache  # and not at once: `check_variants` tells first what scenes lack
    def others() -> dict[str, LabelledScene]:
        places = donors([labelled.episode_id for labelled in scenes], seed=0)
        return {each.scene.scene_id: scenes[place] for each, place in zip(scenes, places, strict=True)}

    def given(see: Painter, labelled: LabelledScene) -> tuple[int, ...]:
        return tuple(codes.encode(see(labelled, next_camera(labelled))).tolist())

    def elsewhere(labelled: LabelledScene, camera: str) -> Frame:
        other = others()[labelled.scene.scene_id]
        return what_came(other, next_camera(other))

    plain = replace(controls, thinking="adaptive", think_threshold=None, imagine="auto", camera=None)
    always = replace(plain, imagine="always")
    asked = Variant(ASKED, family.name, always, route=True, next_camera=True)
    return [
        Variant(AUTO, family.name, plain, route=True),
        Variant(NEVER, family.name, replace(plain, imagine="never"), route=True),
        Variant(ALWAYS, family.name, always, route=True),
        asked,
        replace(asked, name=SHUFFLED, shuffled_images=True),
        replace(asked, name=UNTHINKING, controls=replace(always, thinking="never")),
        *(
            replace(asked, name=name, picture=partial(given, see))
            for name, see in ((GIVEN_CAME, what_came), (GIVEN_UNCHANGED, warped), (GIVEN_OTHER, elsewhere))
        ),
    ]


def imagining(card: ModelCard) -> Family:
    """The family of a checkpoint's first format that imagines.

    Raises:
        ValueError: there is none, or the checkpoint cannot paint.
    """
    for family in map(family_named, card.formats):
        if family.imagination is not None:
            if not card.paints:
                raise ValueError(f"{card.name} has no codes of pictures to paint with")
            return family
    raise ValueError(f"{card.name} writes no format that imagines pictures: it has {', '.join(card.formats)}")


@dataclass(frozen=True)
class ResponseResult:
    """What a scene's draws took: means over the draws.

    Attributes:
        scene_id, episode_id: the scene's own.
        imagine_rate: share that imagined a picture.
        passes: through the network, the prompt apart.
    """

    scene_id: str
    episode_id: str
    imagine_rate: float
    passes: float


@dataclass(frozen=True)
class ImaginationReport:
    """All tables of one evaluation.

    Attributes:
        extractor: whose features tell how far pictures are apart.
        waypoints: rows by protocol.
        responses: what responses took.
        actions: scores by row.
        pictures: rows, and ``frechet`` among their measures.
        entering: how many of those who enter a view the pictures of all such cameras show; no rows where
            nobody does.
        comparisons: what should differ, pair by pair.
        shown: of a few scenes what the camera saw last, what was imagined, and what came.
    """

    extractor: str
    waypoints: Mapping[Protocol, Sequence[FigureRow]]
    responses: Sequence[FigureRow]
    actions: Mapping[str, Sequence[ActionScore]]
    pictures: Sequence[FigureRow]
    entering: Sequence[FigureRow]
    comparisons: Sequence[Comparison]
    shown: Sequence[tuple[Frame, Frame, Frame]] = ()

    def to_json(self) -> dict[str, Any]:
        """All of it as JSON's values."""
        return {
            "extractor": self.extractor,
            "waypoints": {name: [row.to_json() for row in rows] for name, rows in self.waypoints.items()},
            "responses": [row.to_json() for row in self.responses],
            "actions": {name: [asdict(score) for score in of] for name, of in self.actions.items()},
            "pictures": [row.to_json() for row in self.pictures],
            "entering": [row.to_json() for row in self.entering],
            "comparisons": [asdict(comparison) for comparison in self.comparisons],
        }

    def __str__(self) -> str:
        return "\n\n".join("\n".join(aligned(lines)) for lines in self._tables()) + "\n"

    def _tables(self) -> Iterator[list[list[str]]]:
        for protocol, rows in self.waypoints.items():
            yield figure_table(f"waypoints, {protocol}", rows, _WAYPOINT_COLUMNS, _INTERVALS)
        yield figure_table("responses", self.responses, _RESPONSE_COLUMNS, _INTERVALS)
        words = [score.action for score in next(iter(self.actions.values()))] if self.actions else []
        yield [["actions, F1", *words]] + [
            [name, *(cell(score.f1, "{:.1%}") for score in of)] for name, of in self.actions.items()
        ]
        yield figure_table(f"pictures, by the {self.extractor}", self.pictures, _PICTURE_COLUMNS, _INTERVALS)
        if self.entering:
            yield figure_table("entering a view", self.entering, _ENTERING_COLUMNS, _INTERVALS)
        yield [comparison_cells(comparison) for comparison in self.comparisons]


async def evaluate_imagination(
    engine: Engine,
    scenes: Sequence[LabelledScene],
    variants: Sequence[Variant],
    *,
    loaded: Loaded,
    concurrency: int = 16,
    on_result: Callable[[Variant, SceneResult], None] | None = None,
) -> ImaginationReport:
    """Evaluate a started engine of a checkpoint that imagines.

    Args:
        engine: started.
        scenes: with a route and with pictures half a second ahead.
        variants: `imagination_variants`.
        loaded: the same checkpoint: its tower looks at pictures, its codes write what came.
        concurrency: scenes under way at once.
        on_result: called after each scene of each variant, for progress.

    Raises:
        EngineError, RequestError: the engine's.
        ValueError: a scene lacks what a variant asks for.
    """
    family = imagining(engine.card)
    cameras = {labelled.scene.scene_id: next_camera(labelled) for labelled in scenes}
    draws: dict[str, dict[str, Sequence[Draw]]] = {variant.name: {} for variant in variants}

    foreseen: dict[str, dict[str, Frame]] = {}

    def keep(variant: Variant, labelled: LabelledScene, of: Sequence[Draw]) -> None:
        scene_id = labelled.scene.scene_id
        draws[variant.name][scene_id] = of
        if variant.name in (ASKED, SHUFFLED):
            request = request_for(labelled, variant)
            foreseen.setdefault(variant.name, {})[scene_id] = engine.paint(request, imagined_codes(of[0]))

    await evaluate_variants(
        engine, scenes, variants, concurrency=concurrency, on_result=on_result, on_draws=keep
    )
    waypoints = _waypoints(scenes, draws)
    responses = {
        name: [_response(each, of[each.scene.scene_id]) for each in scenes] for name, of in draws.items()
    }
    actions = {}
    if family.actions is not None:
        for name, of in draws.items():
            said = {scene_id: [draw.action for draw in each] for scene_id, each in of.items()}
            actions[name] = action_scores(family.actions, scenes, said)
    painters: dict[str, Painter] = {name: partial(_kept, of) for name, of in foreseen.items()}
    codes = loaded.visual_codes
    assert codes is not None, "a checkpoint that paints has them"
    painters |= {COPIED: copied, WARPED: warped}
    painters |= {UNCHANGED: through_codes(codes, warped), CODED: through_codes(codes, what_came)}
    entered: dict[str, list[EnteringResult]] = {}
    for variant in variants:
        if variant.name == ASKED:
            entered = await evaluate_entering(
                engine, scenes, variant, {CODED: painters[CODED]}, concurrency=concurrency
            )
    extractor = TowerFeatures(loaded)
    pictures = measure_pictures(scenes, cameras, painters, extractor)
    shown = []
    for labelled in scenes[:: -(-len(scenes) // _SHOWN)]:
        camera = cameras[labelled.scene.scene_id]
        imagined = painters[ASKED](labelled, camera)
        shown.append((copied(labelled, camera), imagined, what_came(labelled, camera)))
    return ImaginationReport(
        extractor.name,
        {
            protocol: [FigureRow.of(name, results, WAYPOINT_MEASURES) for name, results in of.items()]
            for protocol, of in waypoints.items()
        },
        [FigureRow.of(name, of, ("imagine_rate", "passes")) for name, of in responses.items()],
        actions,
        [_picture_row(name, of) for name, of in pictures.items()],
        [FigureRow.of(name, of, ("shown",)) for name, of in entered.items()],
        list(_comparisons(waypoints, responses, pictures)),
        shown,
    )


_Waypoints = Mapping[Protocol, Mapping[str, Sequence[WaypointResult]]]


def _waypoints(
    scenes: Sequence[LabelledScene], draws: Mapping[str, Mapping[str, Sequence[Draw]]]
) -> _Waypoints:
    results: dict[Protocol, dict[str, list[WaypointResult]]] = {protocol: {} for protocol in PROTOCOLS}
    for labelled in scenes:
        seen = WaypointScene(labelled)
        told = {
            name: seen.measured(waypoints_of(baseline(labelled.scene.history), TEN_HZ_S)[None])
            for name, baseline in BASELINES.items()
        }
        for name, of in draws.items():
            every = [waypoints_of(draw.trajectory, draw.times_s) for draw in of[labelled.scene.scene_id]]
            told[name] = seen.measured(np.stack(every))
        for name, by_protocol in told.items():
            for protocol, result in by_protocol.items():
                results[protocol].setdefault(name, []).append(result)
    return results


def _response(labelled: LabelledScene, draws: Sequence[Draw]) -> ResponseResult:
    imagined = [draw.foreseen is not None and draw.foreseen.picture is not None for draw in draws]
    passes = [draw.passes for draw in draws]
    about = labelled.scene.scene_id, labelled.episode_id
    return ResponseResult(*about, float(np.mean(imagined)), float(np.mean(passes)))


def _kept(pictures: Mapping[str, Frame], labelled: LabelledScene, camera: str) -> Frame:
    return pictures[labelled.scene.scene_id]


def _picture_row(name: str, pictures: NextFrameResults) -> FigureRow:
    row = FigureRow.of(name, pictures.results, _PICTURE_MEASURES)
    return replace(
        row,
        values={**row.values, "frechet": pictures.frechet},
        intervals={**row.intervals, "frechet": pictures.frechet_interval},
    )


def _comparisons(
    waypoints: _Waypoints,
    responses: Mapping[str, Sequence[ResponseResult]],
    pictures: Mapping[str, NextFrameResults],
) -> Iterator[Comparison]:
    """What should differ. The difference of passes is what a picture takes."""
    told = (UNTHINKING, GIVEN_CAME, GIVEN_UNCHANGED, GIVEN_OTHER)
    for one, other in ((ALWAYS, NEVER), (AUTO, NEVER), (SHUFFLED, ASKED), *((each, ASKED) for each in told)):
        for protocol, of in waypoints.items():
            for measure in ("l2_m", "collision_rate"):
                yield compare(f"{one} : {other} ({protocol})", of[one], of[other], measure)
    for one in (ALWAYS, ASKED):
        yield compare(f"{one} : {NEVER}", responses[one], responses[NEVER], "passes")
    for one, other in ((ASKED, COPIED), (ASKED, WARPED), (ASKED, UNCHANGED), (SHUFFLED, ASKED)):
        for measure in _PICTURE_MEASURES:
            yield compare(f"{one} : {other}", pictures[one].results, pictures[other].results, measure)


_INTERVALS: Final = frozenset({"l2_m", "collision_rate", "passes", *_PICTURE_MEASURES, "frechet", "shown"})
"""Measures whose intervals the text shows; JSON has all."""
_TIMES: Final = ("1 s", "2 s", "3 s", "mean")
_WAYPOINT_COLUMNS: Final[Columns] = dict(
    zip(
        WAYPOINT_MEASURES,
        (
            *((f"L2 {time}, m", "{:.2f}") for time in _TIMES),
            *((f"collisions {time}", "{:.2%}") for time in _TIMES),
        ),
        strict=True,
    )
)
_RESPONSE_COLUMNS: Final[Columns] = {
    "imagine_rate": ("imagines", "{:.1%}"),
    "passes": ("passes", "{:.1f}"),
}
_ENTERING_COLUMNS: Final[Columns] = {"shown": ("shown", "{:.1%}")}
_PICTURE_COLUMNS: Final[Columns] = {
    "psnr_db": ("PSNR, dB", "{:.2f}"),
    "feature_distance": ("features apart", "{:.3f}"),
    "frechet": ("frechet", "{:.3f}"),
}
