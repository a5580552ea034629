"""Of every family, what a stream sends of a draw adds up to what the answer without streaming says of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, get_args

import numpy as np
import pytest

import looktwice.clients.wire as wire
from looktwice.clients.planner import PlanEvent, PlannerClient, PlanResult, attempt_at, plan_request
from looktwice.model.driving.phrases import ReflectionLanguage
from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.model.families.registry import OURS, family_named
from looktwice.model.network.vla_settings import VlaSettings
from looktwice.service.operations.settings import Settings
from tests.checkpoints import noisy_scene, write_untrained
from tests.service.http.test_problem_documents import problem
from tests.service.serving import Served, serve

THINKING: Final[dict[str, tuple[str, ...]]] = {
    "cf_vla": ("adaptive", "always", "never"),
    "traj_only": ("adaptive", "never"),
    "elf_vla": ("adaptive",),
    "elf_vla_refine": ("adaptive",),
    "vla_world": ("adaptive", "never"),
    "toy": ("adaptive", "always", "never"),
}
"""What `thinking` may be in each format."""
SCENE: Final = noisy_scene(1, route=True)


@pytest.fixture(scope="module", params=get_args(ReflectionLanguage))
def served(
    request: pytest.FixtureRequest, toy_family: None, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Served[TorchEngine]]:
    """An untrained checkpoint that writes all formats, in either language of reflections."""
    settings = VlaSettings(name="all", formats=tuple(THINKING), reflection=request.param)
    checkpoint = write_untrained(Path(tmp_path_factory.mktemp("all")) / "all", narrow=True, settings=settings)
    with serve(TorchEngine(checkpoint, TorchSettings(rows=8, products=None)), Settings()) as running:
        yield running


def asked(format: str, **controls: Any) -> wire.PlanRequest:
    family = family_named(format)
    draft = np.zeros((len(family.times_s), 4), np.float32)
    attempt = attempt_at(draft, "Drive.", family.times_s) if family.refines else None
    settings = wire.Controls(n=3, seed=5, numbers="drawn", **controls)
    return plan_request(SCENE, settings, format=format, attempt=attempt)


def told_of(index: int, events: list[tuple[str, PlanEvent]]) -> dict[str, Any]:
    """What the events say of a draw, put together."""
    told: dict[str, Any] = {}
    for name, data in events:
        match data:
            case wire.PlanWritten(index=of, plan=plan) if of == index:
                told[name] = plan.text
            case wire.BranchTaken(index=of, branch=branch) if of == index:
                told[name] = branch
            case wire.ThinkingWritten(index=of, text=text) if of == index:
                told[name] = told.get(name, "") + text
            case wire.SectionWritten(index=of, section=section) if of == index:
                told.setdefault("sections", []).append(section.model_dump())
            case wire.TrajectoryWritten(index=of) if of == index:
                assert name == "trajectory"
                told |= data.model_dump(exclude={"index"})
    return told


def answered(draw: wire.Draw, told: dict[str, Any]) -> dict[str, Any]:
    """The same fields of a whole answer, and every other one that it could have been told of and was."""
    plans = {name: plan.text for name in ("plan", "revised_plan") if (plan := getattr(draw, name))}
    fields = {name: getattr(draw, name) for name in ("branch", "thinking") if getattr(draw, name) is not None}
    names = set(wire.TrajectoryWritten.model_fields) - {"index"}
    if draw.sections:
        fields["sections"] = [section.model_dump() for section in draw.sections]
    return plans | fields | draw.model_dump(include=names)


def test_all_formats_are_known() -> None:
    assert THINKING.keys() == {*OURS, "toy"}


@pytest.mark.parametrize(
    ("format", "thinking"), [(format, each) for format, choices in THINKING.items() for each in choices]
)
def test_the_parts_are_the_whole(served: Served[TorchEngine], format: str, thinking: str) -> None:
    request = asked(format, thinking=thinking, temperature=1.2)
    plain = served.http.post("/v1/plan", json=request.model_dump())
    assert plain.status_code == 200, plain.text
    draws = wire.PlanResponse.model_validate_json(plain.content).draws
    with PlannerClient(served.url) as planner:
        events = list(planner.stream(request))
    name, done = events[-1]
    assert name == "done"
    assert isinstance(done, PlanResult)
    assert [draw.thinking for draw in done.draws] == [draw.thinking for draw in draws]
    for draw in draws:
        told = told_of(draw.index, events)
        assert told == answered(draw, told)
        if thinking != "adaptive":
            assert (draw.thinking is not None) == (thinking == "always")


@pytest.mark.parametrize("format", THINKING)
def test_thinking_that_a_format_cannot_follow_is_refused_by_name(
    served: Served[TorchEngine], format: str
) -> None:
    choices = THINKING[format]
    [card] = served.http.get("/v1/models").json()["models"]
    assert card["thinking"][format] == list(choices)
    wrong: list[dict[str, Any]] = [
        {"thinking": each} for each in get_args(wire.Thinking) if each not in choices
    ]
    wrong += [{"think_threshold": 0.5}] * ("always" not in choices)
    for controls in wrong:
        answer = served.http.post("/v1/plan", json=asked(format, **controls).model_dump())
        [fault] = problem(answer, "invalid-controls").errors
        assert [fault.pointer] == [f"/controls/{name}" for name in controls]
        assert format in fault.detail
    if "always" in choices:
        answer = served.http.post("/v1/plan", json=asked(format, think_threshold=0.0).model_dump())
        draws = wire.PlanResponse.model_validate_json(answer.content).draws
        assert all(draw.thinking is not None for draw in draws)
