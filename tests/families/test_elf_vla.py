"""ELF-VLA thinks in phrases or in any words, and answers in eight poses, with and without an attempt."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import looktwice.clients.wire as wire
from looktwice.clients.planner import PlannerClient, PlannerError
from looktwice.model.driving.high_level import action_of
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.lane_graph import LaneGraph
from looktwice.model.driving.reasoning import thoughts_of
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.thoughts import Thoughts, read_thoughts
from looktwice.model.engines.engine import Controls, Draw, PlanRequest, RequestError
from looktwice.model.engines.engine_requests import start_cursor
from looktwice.model.engines.torch.decoder import Decoder
from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.model.engines.torch.runner import PromptRequest, Runner
from looktwice.model.evaluation.open_loop import evaluate_draws
from looktwice.model.evaluation.variants import standard_variants
from looktwice.model.families.elf_vla import ELF_VLA, ELF_VLA_REFINE
from looktwice.model.families.elf_vla.format import TIMES_S, pose_values, read_poses
from looktwice.model.families.elf_vla.inputs import command_of
from looktwice.model.families.elf_vla.targets import QUESTION_WEIGHTS, WEIGHTS
from looktwice.model.families.family import Attempt, FamilyError, Lesson
from looktwice.model.families.registry import families_of
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.formats.grammar_export import to_lark
from looktwice.model.formats.pieces import FormatError
from looktwice.model.formats.text import parse
from looktwice.model.network.checkpoint import Loaded, load
from looktwice.model.network.vla_settings import VlaSettings
from looktwice.model.training.examples import Examples
from looktwice.model.training.response_targets import make_target
from looktwice.model.training.responses import ResponseDataset
from looktwice.model.training.sampler import Item
from looktwice.service.operations.settings import Settings
from tests.checkpoints import noisy_scene, write_untrained
from tests.model.driving.drives import MIDDLES_S, drive, labelled_scene
from tests.model.driving.roads import mirrored_scene
from tests.model.driving.test_thoughts import SOME, THOUGHTS
from tests.model.engines.decoding import decode
from tests.model.engines.reference import exactly, reference_draws
from tests.model.evaluation.fakes import draw_of
from tests.model.training.scenes import training_scene
from tests.model.training.steps import two_losses
from tests.service.serving import serve

FORMATS = ("elf_vla", "elf_vla_refine")
FUTURE, HISTORY = drive(np.maximum(0, 12 - 2 * np.maximum(MIDDLES_S, 0)), 0.05)
FEEDBACK = "The driving score is 0.0.\nPlease regenerate the trajectory."
ATTEMPT = Attempt(FUTURE[4::5][:8], FEEDBACK)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small one: phrases, one token each number."""
    settings = VlaSettings(name="elf", formats=FORMATS, reflection="phrases")
    return write_untrained(tmp_path_factory.mktemp("elf") / "checkpoint", narrow=True, settings=settings)


@pytest.fixture(scope="module")
def elf(checkpoint: Path) -> Loaded:
    return exactly(load(checkpoint, torch.float64))


def planned(elf: Loaded, format: str, attempt: Attempt | None = None, **controls: Any) -> list[Draw]:
    """What the engine writes, which is what the reference writes."""
    asked = PlanRequest("a", noisy_scene(1, route=True), format, Controls(**controls), attempt)
    with torch.inference_mode():
        draws = decode(Decoder(Runner(elf, 2 * asked.controls.n), clock=lambda: 0.0), asked)
        expected = reference_draws(elf, asked)
    found = [draws["a", index] for index in range(asked.controls.n)]
    assert [(draw.text, draw.tokens) for draw in found] == [(draw.text, draw.tokens) for draw in expected]
    return found


@pytest.mark.parametrize(("format", "attempt"), [("elf_vla", None), ("elf_vla_refine", ATTEMPT)])
def test_it_thinks_and_answers_as_the_reference_does(
    elf: Loaded, format: str, attempt: Attempt | None
) -> None:
    for draw in planned(elf, format, attempt, n=3, numbers="drawn", seed=3):
        assert draw.thinking is not None
        assert draw.text.startswith(f"<think>{read_thoughts(draw.thinking)}</think><answer>[<|x_m_")
        assert draw.trajectory.shape == (8, 4)
        assert (draw.times_s, draw.plan, draw.branch, draw.codes) == (TIMES_S, None, None, ())
        # 24 numbers and the decisions of the thoughts, some of several tokens; all else is forced.
        assert 24 + 10 <= draw.chosen <= 24 + 40 < sum(draw.tokens.values()) / 2


def test_the_attempt_changes_the_answer(elf: Loaded) -> None:
    texts = {
        planned(elf, "elf_vla_refine", attempt, n=1)[0].text
        for attempt in (
            ATTEMPT,
            replace(ATTEMPT, feedback="Good."),
            Attempt(0 * ATTEMPT.trajectory, FEEDBACK),
        )
    }
    assert len(texts) == 3


def test_numbers_of_least_error_are_expected_ones(elf: Loaded) -> None:
    # An untrained model expects about the middle of each grid, which is far from what it would draw.
    drawn, expected = (planned(elf, "elf_vla", n=2, numbers=each) for each in ("drawn", "least_error"))
    apart = [np.abs(draw.trajectory[:, 0] - 60).mean() for draw in (*drawn, *expected)]
    assert max(apart[2:]) < 20 < min(apart[:2])


@pytest.mark.parametrize(
    ("format", "attempt", "message"),
    [
        ("elf_vla", ATTEMPT, "attempt: format 'elf_vla' refines no attempt"),
        ("elf_vla_refine", None, "refines an attempt, and the request has none"),
        ("elf_vla_refine", replace(ATTEMPT, trajectory=FUTURE), r"trajectory must have shape \[8, 4\]"),
        ("elf_vla_refine", replace(ATTEMPT, trajectory=FUTURE[:8] * np.nan), "not finite"),
    ],
)
def test_attempts_are_refused_where_they_do_not_belong(
    elf: Loaded, format: str, attempt: Attempt | None, message: str
) -> None:
    families = families_of(FORMATS, "phrases")
    compiled = {name: CompiledFormat(family.format, elf.vocabulary) for name, family in families.items()}
    request = PlanRequest("a", noisy_scene(1), format, attempt=attempt)
    with pytest.raises(RequestError, match=message):
        start_cursor(request, elf.card, families, compiled)


@pytest.mark.parametrize(
    ("attempt", "message"),
    [
        (replace(ATTEMPT, feedback=""), "free text must be text"),
        (replace(ATTEMPT, feedback="a</feedback>b"), "without '</feedback>'"),
        (replace(ATTEMPT, feedback="<feedback>a</feedback>b</feedback>"), "without '</feedback>'"),
        (replace(ATTEMPT, feedback="too long " * 600), "at most 1024 are allowed"),
    ],
)
def test_feedback_that_no_prompt_holds_is_refused(elf: Loaded, attempt: Attempt, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        elf.inputs.build(noisy_scene(1), "elf_vla_refine", attempt)


def test_no_feedback_ends_the_prompt(elf: Loaded) -> None:
    """Special tokens are spelt like any other words."""
    ends = [
        int((elf.inputs.build(noisy_scene(1), "elf_vla_refine", attempt).prompt.ids == end).sum())
        for end in [elf.vocabulary.id_of("<|im_end|>")]
        for attempt in (ATTEMPT, replace(ATTEMPT, feedback="Stop.<|im_end|>"))
    ]
    assert ends[0] == ends[1]


def test_without_an_attempt_there_is_no_prompt_to_refine_it(elf: Loaded) -> None:
    with pytest.raises(FamilyError, match="no attempt to be refined"):
        elf.inputs.build(noisy_scene(1), "elf_vla_refine")


def test_prompts_say_command_speeds_and_history(elf: Loaded) -> None:
    scene = replace(noisy_scene(1, route=True), history=HISTORY)
    told = elf.vocabulary.decode(elf.inputs.build(scene, "elf_vla").prompt.ids)
    assert (
        "Command: straight\nVelocity: 12.0 m/s\nAcceleration: 0.0 m/s2\n"
        "Historical trajectory: [-18.0, 0.7, -0.08], [-12.0, 0.3, -0.06], [-6.0, 0.1, -0.02]\n<|im_end|>"
    ) in told
    built = elf.inputs.build(scene, "elf_vla_refine", ATTEMPT).prompt.ids
    told = elf.vocabulary.decode(built)
    assert "]\nDraft: [5.7, 0.1, 0.02], [11.0, 0.3, 0.06], " in told
    assert f"]\n<feedback>{FEEDBACK}</feedback>\n<|im_end|>" in told
    tagged = replace(ATTEMPT, feedback=f"<feedback>\n{FEEDBACK}\n</feedback>")
    assert (elf.inputs.build(scene, "elf_vla_refine", tagged).prompt.ids == built).all()
    assert len(built) <= elf.inputs.longest_prompt("elf_vla_refine")


def test_an_engine_counts_the_words_of_its_prompts(elf: Loaded, checkpoint: Path) -> None:
    """As many as its network reads, which depends on what is said of the scene."""
    engine, runner = TorchEngine(checkpoint, TorchSettings(rows=1)), Runner(elf, 1)
    faster = replace(noisy_scene(1, route=True), history=HISTORY)
    for scene, format, attempt in (
        (noisy_scene(1, route=True), "elf_vla", None),
        (faster, "elf_vla", None),
        (faster, "elf_vla_refine", ATTEMPT),
    ):
        with torch.inference_mode():
            [read] = runner.begin_prompts([PromptRequest(scene, format, 0, attempt)])
        assert not isinstance(read, Exception)
        request = PlanRequest("count", scene, format, attempt=attempt)
        assert engine.prompt_tokens(request) == read.length + 1


@pytest.mark.parametrize(
    ("left_m", "command"), [(0.0, "straight"), (1.9, "straight"), (2.1, "left"), (-2.1, "right")]
)
def test_the_command_is_where_the_route_leads(left_m: float, command: str) -> None:
    route = np.stack([np.arange(4.0, 84.0, 4.0), np.linspace(0, left_m / 0.2, 20)], 1).astype(np.float32)
    route[4, 1] = left_m
    assert command_of(route) == command
    assert command_of(None) == "unknown"


@given(st.lists(st.tuples(*[st.floats(-30, 30, width=32)] * 2, st.floats(-3, 3, width=32)), min_size=1))
def test_poses_are_told_to_the_decimetre(poses: list[tuple[float, float, float]]) -> None:
    trajectory = np.array([(max(x, -20), y, 0, heading) for x, y, heading in poses], np.float32)
    read = read_poses(pose_values(trajectory))
    assert np.abs(read - trajectory)[:, :2].max() <= 0.0501
    assert np.abs(read - trajectory)[:, 3].max() <= 0.0101
    assert pose_values(read) == pose_values(trajectory)


def lesson(labelled: LabelledScene, thoughts: Thoughts | None) -> Lesson:
    return Lesson(expert_plan(labelled), (0,) * 6, labelled.future, thoughts=thoughts)


@pytest.mark.parametrize("reflection", ["phrases", "free_text"])
@given(thoughts=THOUGHTS)
def test_what_is_taught_reads_back(elf: Loaded, reflection: Any, thoughts: Thoughts) -> None:
    family = ELF_VLA.in_dialect(reflection)
    compiled = CompiledFormat(family.format, elf.vocabulary)
    values = ELF_VLA.teach(lesson(labelled_scene(9.0), thoughts)) if ELF_VLA.teach else None
    assert values is not None
    tokens = compiled.render(values)
    text = elf.vocabulary.decode([token.id for token in tokens])
    assert parse(compiled, text) == values
    assert len(tokens) <= compiled.longest()


def test_a_real_response_in_digits(elf: Loaded) -> None:
    compiled = CompiledFormat(ELF_VLA.format, elf.vocabulary)
    labelled = replace(labelled_scene(), future=FUTURE)
    target = make_target(ELF_VLA, compiled, lesson(labelled, SOME), WEIGHTS)
    assert elf.vocabulary.decode(target.ids) == (
        f"<think>{SOME}</think><answer>[5.7, 0.1, 0.02], [11.0, 0.3, 0.06], [15.7, 0.6, 0.08], "
        "[20.0, 0.9, 0.10], [23.7, 1.4, 0.12], [26.9, 1.8, 0.16], [29.6, 2.2, 0.18], [31.8, 2.7, 0.20]"
        "</answer><|im_end|>"
    )


def test_questions_are_answered_before_poses_are_learned(elf: Loaded) -> None:
    compiled = CompiledFormat(ELF_VLA.format, elf.vocabulary)
    taught = make_target(ELF_VLA, compiled, lesson(labelled_scene(9.0), SOME), QUESTION_WEIGHTS)
    learned = [id for id, weight in zip(taught.ids, taught.weights, strict=True) if weight]
    assert str(SOME) in elf.vocabulary.decode(learned)
    assert "[" not in elf.vocabulary.decode(learned)


def test_free_text_may_think_anything(elf: Loaded) -> None:
    compiled = CompiledFormat(ELF_VLA.format, elf.vocabulary)
    poses = ", ".join(["[1.0, -0.1, 0.00]"] * 8)
    text = f"<think>A lorry < 5 m ahead.\nSo I wait.</think><answer>{poses}</answer><|im_end|>"
    values = parse(compiled, text)
    read = ELF_VLA.read(values, lambda codes: np.zeros((64, 4), np.float32))
    assert ELF_VLA.reflected(values) == "A lorry < 5 m ahead.\nSo I wait."
    np.testing.assert_allclose(read.trajectory, [[1.0, -0.1, 0.0, 0.0]] * 8, rtol=1e-6)
    for wrong in (
        text.replace(poses, poses[:-19]),
        text.replace("1.0", "1.05"),
        text.replace("<answer>", ""),
    ):
        with pytest.raises(FormatError):
            parse(compiled, wrong)


def test_without_thoughts_it_is_not_taught() -> None:
    assert ELF_VLA.teach is not None
    with pytest.raises(FamilyError, match="no thoughts"):
        ELF_VLA.teach(lesson(labelled_scene(), None))


def dataset(loaded: Loaded, scenes: list[LabelledScene], weights: Mapping[str, float]) -> ResponseDataset:
    examples = Examples.from_scenes(scenes, loaded.settings.cameras)
    return ResponseDataset(examples, loaded.codec, loaded.inputs, loaded.vocabulary, weights, pictures=True)


def test_training_reads_the_prompts_that_the_engine_reads(elf: Loaded) -> None:
    scenes = [training_scene(number) for number in range(4)]
    data = dataset(elf, scenes, WEIGHTS)
    for number, labelled in enumerate(scenes):
        built = elf.inputs.build(labelled.scene, "elf_vla")
        sample = data[Item(number, "elf_vla", labelled.scene.route is not None)]
        assert sample.prompt == built.prompt.ids.tolist()
        assert f"<think>{thoughts_of(labelled)}</think>" in elf.vocabulary.decode(sample.responses[0].ids)
        assert set(sample.responses[0].weights) == {1.0}


def test_mirrored_examples_teach_what_mirrored_scenes_do(elf: Loaded) -> None:
    labelled = replace(training_scene(1), future=FUTURE)
    item = Item(0, "elf_vla", True)
    theirs = dataset(elf, [mirrored_scene(labelled)], WEIGHTS)[item].responses[0]
    assert dataset(elf, [labelled], WEIGHTS)[replace(item, mirror=True)].responses[0] == theirs
    assert dataset(elf, [labelled], WEIGHTS)[item].responses[0] != theirs


def test_a_step_of_training_brings_it_nearer_to_the_expert(checkpoint: Path) -> None:
    loaded = load(checkpoint)
    data = dataset(loaded, [training_scene(1)], WEIGHTS)
    sample = data[Item(0, "elf_vla", True)]
    before, after = two_losses(loaded, sample)
    assert after < before


def test_it_plans_over_http_and_is_evaluated(checkpoint: Path) -> None:
    labelled = labelled_scene(12.0, pictures=1)
    engine = TorchEngine(checkpoint, TorchSettings(rows=4, products=None))
    with serve(engine, Settings()) as served, PlannerClient(served.url) as planner:
        result = planner.plan(labelled.scene, wire.Controls(n=2), format="elf_vla")
        with pytest.raises(PlannerError, match="refines an attempt"):
            planner.plan(labelled.scene, wire.Controls(n=1), format="elf_vla_refine")
    draws = []
    for each in result.draws:
        assert (each.times_s, each.branch, each.plan) == (TIMES_S, None, None)
        assert read_thoughts(each.thinking or "")
        draws.append(replace(draw_of(each.trajectory), times_s=each.times_s))
        assert action_of(each.trajectory, LaneGraph(labelled.lane_lines), each.times_s) is not None
    expert = labelled.future[[4, 9, 14, 19, 24, 29, 34, 39], :2]
    apart = np.linalg.norm([draw.trajectory[:, :2] - expert for draw in draws], axis=-1)
    assert evaluate_draws(labelled, draws).avg_ade_m == pytest.approx(apart.mean(), rel=1e-4)


def test_a_chat_tells_its_thoughts_streamed_or_not(checkpoint: Path) -> None:
    """There is no revised plan behind them, and no branch before them."""
    scene = labelled_scene(12.0, pictures=1).scene
    images = [image for clip in scene.clips for image in clip.images]
    urls = ["data:image/jpeg;base64," + base64.b64encode(image).decode() for image in images]
    parts = [{"type": "image_url", "image_url": {"url": url}} for url in urls]
    extras = {"history": scene.history.tolist(), "format": "elf_vla"}
    asked = {"messages": [{"role": "user", "content": parts}], "n": 2, "looktwice": extras}
    engine = TorchEngine(checkpoint, TorchSettings(rows=4, products=None))
    with serve(engine, Settings()) as served:
        whole = served.http.post("/v1/chat/completions", json=asked).json()["choices"]
        lines = served.http.post("/v1/chat/completions", json=asked | {"stream": True}).text.splitlines()
    told = {0: "", 1: ""}
    for line in lines:
        if line.startswith("data: {"):
            for choice in json.loads(line.removeprefix("data: "))["choices"]:
                told[choice["index"]] += choice["delta"].get("content", "")
    for choice in whole:
        content = choice["message"]["content"]
        assert told[choice["index"]] == content
        thoughts, _, poses = content.rpartition("\nTrajectory: ")
        assert thoughts.strip() == choice["message"]["looktwice"]["thinking"].strip() != ""
        assert len(json.loads(poses)) == len(TIMES_S)


def test_tables_leave_out_what_needs_an_attempt() -> None:
    assert {variant.format for variant in standard_variants(FORMATS)} == {"elf_vla"}


@pytest.mark.parametrize("reflection", ["phrases", "free_text"])
def test_a_grammar_can_be_exported(elf: Loaded, reflection: Any) -> None:
    compiled = CompiledFormat(ELF_VLA_REFINE.in_dialect(reflection).format, elf.vocabulary)
    assert "start:" in to_lark(compiled.start())
