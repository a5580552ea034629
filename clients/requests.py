"""Bodies of requests, from the model's words to the wire's."""

from __future__ import annotations

from collections.abc import Sequence

from looktwice.clients import wire, wire_imagine, wire_refine
from looktwice.clients.wire_values import rows, wire_agents, wire_scene
from looktwice.model.driving.outcome import Outcome
from looktwice.model.driving.plan import Plan
from looktwice.model.driving.scene import Scene
from looktwice.model.driving.trajectory import TEN_HZ_S, FloatArray
from looktwice.model.driving.view import Surroundings


def plan_request(
    scene: Scene,
    controls: wire.Controls = wire.Controls(),
    *,
    prefill: Plan | None = None,
    format: str | None = None,
    attempt: wire.Attempt | None = None,
) -> wire.PlanRequest:
    """The body of POST /v1/plan for ``scene``."""
    if prefill is not None:
        controls = controls.model_copy(update={"prefill": str(prefill)})
    return wire.PlanRequest(scene=wire_scene(scene), controls=controls, format=format, attempt=attempt)


def attempt_at(trajectory: FloatArray, feedback: str, times_s: Sequence[float] = TEN_HZ_S) -> wire.Attempt:
    """An attempt to be refined: a draft [t, 4] with poses at ``times_s``, and feedback on it."""
    return wire.Attempt(trajectory=rows(trajectory), times_s=_told(times_s), feedback=feedback)


def reflect_request(
    scene: Scene,
    plan: Plan,
    controls: wire.ReflectControls = wire.ReflectControls(),
    *,
    format: str | None = None,
) -> wire.ReflectRequest:
    """The body of POST /v1/reflect for ``plan`` in ``scene``."""
    return wire.ReflectRequest(scene=wire_scene(scene), plan=str(plan), controls=controls, format=format)


def refine_request(
    scene: Scene,
    draft: FloatArray,
    feedback: str | wire_refine.SectionsGiven = wire_refine.AUTO,
    controls: wire.ReflectControls = wire.ReflectControls(),
    *,
    threshold: float = 0.8,
) -> wire_refine.RefineRequest:
    """The body of POST /v1/refine for a ``draft`` [8, 4] at 0.5 s or [64, 4] at 0.1 s in ``scene``."""
    return wire_refine.RefineRequest(
        scene=wire_scene(scene),
        draft=rows(draft),
        feedback=feedback,
        threshold=threshold,
        controls=controls,
    )


def imagine_request(
    scene: Scene,
    camera: wire.Camera,
    controls: wire_imagine.ImagineControls = wire_imagine.ImagineControls(),
    trajectory: FloatArray | None = None,
    times_s: Sequence[float] = TEN_HZ_S,
) -> wire_imagine.ImagineRequest:
    """The body of POST /v1/imagine for what ``camera`` sees half a second after ``scene``.

    With a ``trajectory`` [t, 4] with poses at ``times_s``, such as those of a draw, it asks what the camera
    would see if the ego drove that.
    """
    return wire_imagine.ImagineRequest(
        scene=wire_scene(scene),
        camera=camera,
        trajectory=None if trajectory is None else rows(trajectory),
        times_s=None if trajectory is None else _told(times_s),
        controls=controls,
    )


def _told(times_s: Sequence[float]) -> list[float] | None:
    """Times as the wire has them."""
    return None if tuple(times_s) == TEN_HZ_S else list(times_s)


def label_request(
    scene: Scene,
    predicted: Plan,
    expert: Plan,
    surroundings: Surroundings | None = None,
    seed: int = 0,
    outcome: Outcome | None = None,
) -> wire.LabelRequest:
    """The body of POST /v1/label for two plans in ``scene``; an ``outcome`` is that of a plan that failed."""
    return wire.LabelRequest(
        scene=wire_scene(scene),
        predicted_plan=str(predicted),
        expert_plan=str(expert),
        annotations=None
        if surroundings is None
        else wire.Annotations(
            agents=wire_agents(surroundings.agents),
            lane_lines=[rows(line) for line in surroundings.lane_lines],
        ),
        outcome=None if outcome is None else wire.PlanOutcome.model_validate(outcome.to_json()),
        seed=seed,
    )
