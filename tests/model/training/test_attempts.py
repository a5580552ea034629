"""A model's own answers with feedback become examples of refinement."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from looktwice.model.driving.feedback_store import FeedbackFileError, FeedbackRow, write_feedback
from looktwice.model.driving.reasoning import thoughts_of
from looktwice.model.driving.scene import FRONT_WIDE
from looktwice.model.driving.scene_store import write_scenes
from looktwice.model.driving.trajectory import HALF_SECONDS_S
from looktwice.model.families.elf_vla.targets import WEIGHTS
from looktwice.model.families.family import JudgedAttempt
from looktwice.model.network.checkpoint import Loaded, load, with_formats
from looktwice.model.training.attempts import place_attempts
from looktwice.model.training.examples import Examples
from looktwice.model.training.recipes import NANO
from looktwice.model.training.responses import ResponseDataset
from looktwice.model.training.run import run
from looktwice.model.training.run_settings import RunSettings
from looktwice.model.training.sampler import Item, TaskSampler
from tests.model.driving.test_thoughts import SOME
from tests.model.training.feedback_rows import EIGHT, feedback_row
from tests.model.training.scenes import training_scene

SCENES = [training_scene(index) for index in range(6)]
EXAMPLES = Examples.from_scenes(SCENES, (FRONT_WIDE,))
FORMATS = ("elf_vla", "elf_vla_refine")
ALL = np.ones(len(EXAMPLES), np.bool_)


@pytest.fixture(scope="module")
def elf(resampling_checkpoint: Path) -> Loaded:
    return with_formats(load(resampling_checkpoint), FORMATS)


def dataset(elf: Loaded, rows: list[FeedbackRow]) -> ResponseDataset:
    examples = Examples.from_scenes(SCENES, elf.settings.cameras)
    found = place_attempts(examples, rows, HALF_SECONDS_S, ALL)
    return ResponseDataset(
        examples,
        elf.codec,
        elf.inputs,
        elf.vocabulary,
        WEIGHTS,
        pictures=True,
        attempts=found.attempts,
        attempting="elf_vla_refine",
    )


def test_answers_find_their_scenes_and_times() -> None:
    dense = [[0.8 * step, 0.5, 0.02] for step in range(1, 65)]
    found = place_attempts(
        EXAMPLES,
        [feedback_row("scene-4"), replace(feedback_row("scene-0"), trajectory=dense)],
        HALF_SECONDS_S,
        ALL,
    )
    assert found.examples.tolist() == [4, 0]
    for each in found.attempts:
        np.testing.assert_allclose(each.attempt.trajectory[:, [0, 1, 3]], EIGHT, rtol=1e-6)
        assert "It's too fast." in each.attempt.feedback
    with pytest.raises(ValueError, match="feedback on scene nowhere, which is not among"):
        place_attempts(EXAMPLES, [feedback_row("nowhere")], HALF_SECONDS_S, ALL)
    with pytest.raises(ValueError, match="draw 1 in scene scene-4 is right and has no thoughts"):
        place_attempts(EXAMPLES, [feedback_row("scene-4", correct=True, think=None)], HALF_SECONDS_S, ALL)


def test_wrong_answers_are_left_out_where_the_expert_tells_no_thoughts() -> None:
    rows = [feedback_row("scene-4"), feedback_row("scene-4", correct=True), feedback_row("scene-0")]
    found = place_attempts(EXAMPLES, rows, HALF_SECONDS_S, np.arange(len(EXAMPLES)) != 4)
    assert [(int(place), each.correct) for place, each in zip(*found, strict=True)] == [(4, True), (0, False)]


def test_what_was_wrong_is_corrected_and_what_was_right_is_said_again(elf: Loaded) -> None:
    data = dataset(elf, [feedback_row("scene-4"), feedback_row("scene-4", correct=True)])
    expert = data[Item(4, "elf_vla", True)].responses[0]
    samples = [data[Item(4, "elf_vla_refine", True, attempt=place)] for place in range(2)]
    wrong, right = (elf.vocabulary.decode(sample.responses[0].ids) for sample in samples)
    assert samples[0].responses[0] == expert
    assert f"<think>{thoughts_of(SCENES[4])}</think>" in wrong
    assert f"<think>{SOME}</think><answer>[<|x_m_" in right
    for sample, feedback in zip(samples, ("It's too fast.", "The driving score is 0.9."), strict=True):
        prompt = elf.vocabulary.decode(sample.prompt)
        assert "Draft: [4.0, 0.5, 0.02], [8.0, 0.5, 0.02], " in prompt
        assert feedback in prompt


def test_training_reads_the_prompts_that_the_engine_reads(elf: Loaded) -> None:
    rows = [feedback_row("scene-4")]
    [tried] = place_attempts(EXAMPLES, rows, HALF_SECONDS_S, ALL).attempts
    built = elf.inputs.build(SCENES[4].scene, "elf_vla_refine", tried.attempt)
    assert dataset(elf, rows)[Item(4, "elf_vla_refine", True, attempt=0)].prompt == built.prompt.ids.tolist()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (replace(feedback_row("scene-1"), feedback="too long " * 1100), "attempt 0 cannot be learned.*1024"),
        (feedback_row("scene-1", correct=True, think="I brake."), "attempt 0 cannot be learned.*no thoughts"),
    ],
)
def test_what_no_prompt_or_answer_holds_is_refused_before_training(
    elf: Loaded, wrong: FeedbackRow, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        dataset(elf, [wrong])


def test_every_attempt_is_learned_once_an_epoch_beside_all_examples() -> None:
    def items(attempted: list[int]) -> list[Item]:
        sampler = TaskSampler(
            np.ones(6, np.bool_),
            6,
            {"elf_vla": 1.0},
            0.5,
            0,
            attempted=np.array(attempted, np.int64),
            attempting="elf_vla_refine" if attempted else None,
            mirror_share=0.5,
            blur_share=0.5,
        )
        batches = list(sampler)
        assert len(sampler) == len(batches)
        return [item for batch in batches for item in batch]

    found = items([3, 3, 0, 5])
    tried = [item for item in found if item.attempt is not None]
    # Others come six at a time, and these alone.
    assert sorted((item.attempt, item.index) for item in tried) == [(0, 3), (1, 3), (2, 0), (3, 5)]
    assert {(item.task, item.mirror, item.blur) for item in tried} == {("elf_vla_refine", False, False)}
    # The others are learned as they are without attempts.
    plain = {item for item in found if item.attempt is None}
    assert plain == set(items([]))
    with pytest.raises(ValueError, match="attempts need a format"):
        TaskSampler(np.ones(6, np.bool_), 2, {"elf_vla": 1.0}, 0.5, 0, attempted=np.zeros(1, np.int64))


def test_a_run_learns_to_refine_and_tells_so(resampling_checkpoint: Path, tmp_path: Path) -> None:
    scenes, file = tmp_path / "scenes", tmp_path / "feedback.parquet"
    write_scenes(scenes / "a.parquet", SCENES)
    write_feedback(
        file,
        [
            feedback_row("scene-1"),
            feedback_row("scene-2"),
            feedback_row("scene-2", correct=True),
            feedback_row("scene-3"),
        ],
    )
    recipe = replace(NANO["elf-sft"], steps=4, batch_size=2, warmup_steps=1)
    settings = RunSettings(tmp_path / "cache", bf16=False)

    def trained(recipe_name: str = "elf-sft") -> None:
        chosen = recipe if recipe_name == "elf-sft" else NANO[recipe_name]
        run(chosen, scenes, resampling_checkpoint, tmp_path / "done", settings, failures=file)

    trained()
    done = load(tmp_path / "done")
    assert done.card.formats[-2:] == FORMATS
    [stage] = done.card.details["stages"]
    assert (stage["failures_count"], stage["right_answers_count"]) == (3, 1)
    with pytest.raises(ValueError, match="recipe meta-act takes no failures"):
        trained("meta-act")
    write_feedback(file, [feedback_row("scene-99")])
    with pytest.raises(ValueError, match="scene-99, which is not among"):
        trained()
    write_scenes(file, SCENES[:1])
    with pytest.raises(FeedbackFileError, match="no feedback of version 1"):
        trained()


def test_a_right_answer_is_told_as_it_was(elf: Loaded) -> None:
    [tried] = place_attempts(EXAMPLES, [feedback_row("scene-4", correct=True)], HALF_SECONDS_S, ALL).attempts
    assert isinstance(tried, JudgedAttempt)
    assert tried.thinking == str(SOME)
