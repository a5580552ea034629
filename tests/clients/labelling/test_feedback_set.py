"""The feedback set: what is sampled, what is kept, and that a kill loses and doubles nothing."""

from __future__ import annotations

import asyncio
import json
import multiprocessing
import random
import signal
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse, Response
from starlette.requests import ClientDisconnect

from looktwice.clients.labelling.feedback_set import (
    FeedbackSample,
    Inference,
    feedback_config,
    feedback_jobs,
    inference_config,
    judge,
    rows,
    sampled,
)
from looktwice.clients.labelling.ledger import Ledger, StageRun
from looktwice.clients.labelling.teachers.feedback_teacher import check_feedback, question_of
from looktwice.clients.labelling.teachers.openai import OpenAiSettings, OpenAiTeacher
from looktwice.model.driving.feedback_store import FeedbackFileError, read_feedback, write_feedback
from looktwice.model.driving.pdm.feedback import Feedback
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.scene_store import write_scenes
from looktwice.service.operations.settings import Settings
from tests.clients.labelling.builds import MODEL, completion, named
from tests.clients.labelling.killed import AT_ONCE, fail_all
from tests.service.scenes import labelled
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import serve
from tests.sockets import PATIENCE_S, listening

SCENES, KILLS = 24, 8
OWN = str(Feedback("The plan is wrong.", "It overlooks another.", "NC=0.", "EP is 0.", "Brake."))


def differing() -> Iterator[LabelledScene]:
    """Scenes in which the leader stands elsewhere, so that no two questions are the same."""
    one = labelled("scene")
    leader, *others = one.agents
    for number in range(SCENES):
        poses = leader.poses.copy()
        poses[:, 0] += 0.1 * number
        scene = replace(one, agents=(replace(leader, poses=poses), *others))
        yield named(scene, f"scene-{number:04d}")


class CountingTeacher:
    """Writes feedback, takes a moment for it, and counts what it is asked."""

    def __init__(self) -> None:
        self.answered: list[tuple[str, str]] = []

    def app(self) -> FastAPI:
        app = FastAPI()

        @app.post("/v1/chat/completions")
        async def complete(request: Request) -> Response:
            try:
                body: dict[str, Any] = json.loads(await request.body())
            except ClientDisconnect:
                return Response(status_code=499)
            await asyncio.sleep(0.01)
            self.answered.append((request.headers["Authorization"], body["messages"][1]["content"]))
            return JSONResponse(completion(OWN))

        return app


def test_killed_at_any_moment_it_goes_on_where_it_was(tmp_path: Path) -> None:
    file, folder = tmp_path / "scenes.parquet", tmp_path / "failures"
    write_scenes(file, differing())
    inference, sample = Inference(n=2), FeedbackSample(threshold=1.0)
    unasked = OpenAiTeacher(OpenAiSettings("", "some-vlm"))

    def runs(ledger: Ledger) -> tuple[StageRun, StageRun]:
        inferred = ledger.run("inference", inference_config(MODEL, inference))
        return inferred, ledger.run("feedback", feedback_config(inferred, unasked, sample.threshold))

    def recorded() -> tuple[set[str], set[str]]:
        """Scenes that are inferred, and prompts whose answers are kept."""
        with Ledger(folder) as ledger:
            inferred, feedback = runs(ledger)
            chosen = sampled(ledger, inferred, sample)
            prompts = set()
            for job in feedback_jobs(ledger, inferred, feedback, chosen, file):
                if ledger.answers(job.key):
                    draw = job.subject.entry.record["draws"][job.subject.draw]
                    (judged,) = judge(job.subject.labelled, [draw], inference.version, sample.threshold)
                    prompts.add(question_of(judged).prompt)
            return {entry.scene_id for entry in ledger.entries(inferred)}, prompts

    luck, teacher, engine = random.Random(2), CountingTeacher(), ScriptedEngine()
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["tests.clients.labelling.killed"])

    def has_come(submitted: int | None, more: int) -> bool:
        """Whether so many scenes more are under way; or, where there were to be none, so many questions."""
        if submitted is not None:
            return len(engine.submitted) >= submitted + more
        return len(teacher.answered) >= asked_before + more

    with (
        serve(engine, Settings(bundled_scenes=tmp_path / "none")) as served,
        listening(teacher.app()) as (url, _),
    ):
        for life in range(KILLS + 1):
            scenes_before, prompts_before = recorded()
            submitted, asked_before = len(engine.submitted), len(teacher.answered)
            key = f"life {life}"
            if life == KILLS:
                fail_all(folder, file, served.url, url, key)
            else:
                process = processes.Process(target=fail_all, args=(folder, file, served.url, url, key))
                process.start()
                more = luck.randint(1, 5)
                served.until(partial(has_come, submitted if life < KILLS // 2 else None, more))
                process.kill()
                process.join(PATIENCE_S)
                assert process.exitcode == -signal.SIGKILL, "it was to be killed in the middle of its work"
            again = [request.scene.scene_id for request in engine.submitted[submitted:]]
            asked = [prompt for who, prompt in teacher.answered if who == f"Bearer {key}"]
            assert not scenes_before & set(again), "a scene that was inferred was inferred again"
            assert not prompts_before & set(asked), "a teacher was asked again for what it had answered"
            assert len(set(asked)) == len(asked), "one life asked twice"
    with Ledger(folder) as ledger:
        inferred, feedback = runs(ledger)
        assert (ledger.count(inferred), ledger.count(inferred, "dead")) == (SCENES, 0)
        chosen = sampled(ledger, inferred, sample)
        count = sum(map(len, chosen.values()))
        assert (ledger.count(feedback), ledger.count(feedback, "dead")) == (count, 0)
        found = list(rows(ledger, inferred, feedback, chosen))
        wrong = [row for row in found if not row.correct]
        assert ledger.spent(feedback).answers == len(wrong) > SCENES
    assert len({(row.scene_id, row.draw) for row in found}) == count
    assert {row.feedback for row in wrong} == {OWN}
    # Answers that were on their way when the process died are all that can be paid again.
    assert 0 <= len(teacher.answered) - len(wrong) <= KILLS * AT_ONCE


def response(score: float) -> dict[str, Any]:
    return {"draws": [{"plan": None, "think": None, "trajectory": [], "score": score, "is_partial": False}]}


def inferred_ledger(folder: Path, scores: list[float]) -> tuple[Ledger, StageRun]:
    ledger = Ledger(folder)
    run = ledger.run("inference", inference_config(MODEL, Inference(n=1)))
    for number, score in enumerate(scores):
        ledger.finish(run, f"key-{number:03d}", f"scene-{number:03d}", response(score))
    return ledger, run


def test_a_sample_takes_so_many_of_each_kind_and_is_not_shuffled_by_more_scenes(tmp_path: Path) -> None:
    scores = [0.1 * (number % 10) for number in range(60)]
    ledger, run = inferred_ledger(tmp_path, scores)
    with ledger:

        def kinds(sample: FeedbackSample) -> list[bool]:
            chosen = sampled(ledger, run, sample)
            return [scores[int(key[-3:])] >= sample.threshold for key in chosen]

        few = FeedbackSample(0.8, correct=5, wrong=7)
        assert (kinds(few).count(True), kinds(few).count(False)) == (5, 7)
        assert kinds(FeedbackSample()).count(True) == 12
        assert kinds(FeedbackSample(0.0)).count(False) == 0
        before = set(sampled(ledger, run, few))
        assert before != set(sampled(ledger, run, replace(few, seed=1)))
        ledger.finish(run, "key-100", "scene-100", response(0.0))
        assert len(before & set(sampled(ledger, run, few))) >= 11
    with pytest.raises(ValueError, match="threshold"):
        FeedbackSample(threshold=1.5)


def test_the_file_is_whole_and_of_its_version(tmp_path: Path) -> None:
    path = tmp_path / "feedback.parquet"
    assert write_feedback(path, []) == 0
    assert list(read_feedback(path)) == []
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(FeedbackFileError, match="not a whole"):
        list(read_feedback(path))
    write_scenes(path, [labelled("scene")])
    with pytest.raises(FeedbackFileError, match="version 1"):
        list(read_feedback(path))


def test_the_answer_used_here_passes_the_checks() -> None:
    one = labelled("scene")
    stand = {"plan": None, "think": None, "trajectory": [[0.0, 0.0, 0.0]] * 8}
    (judged,) = judge(one, [stand], "v1.1", 0.8)
    assert isinstance(check_feedback(OWN, question_of(judged)), Feedback)
