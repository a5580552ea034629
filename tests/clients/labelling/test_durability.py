"""Killed at any moment and run again: nothing is lost, and nothing is paid twice."""

from __future__ import annotations

import asyncio
import json
import multiprocessing
import random
import signal
import threading
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse, Response
from starlette.requests import ClientDisconnect

from looktwice.clients.labelling.label import config_of, jobs, questions
from looktwice.clients.labelling.ledger import Ledger
from looktwice.clients.labelling.rollout import Sampling, key_of
from looktwice.clients.labelling.rollout import config_of as rollout_config
from looktwice.clients.labelling.teachers.openai import OpenAiSettings, OpenAiTeacher
from looktwice.model.driving.hashing import hash_of
from looktwice.model.driving.plan import Plan, format_tick, parse_plan
from tests.clients.labelling.builds import GOOD, LEAKING, MODEL, completion, named, rollout_record, scenes
from tests.clients.labelling.killed import AT_ONCE, label_all
from tests.service.scenes import labelled
from tests.sockets import PATIENCE_S, listening

SCENES, KILLS = 240, 50


def own_plan(number: int) -> Plan:
    """A plan that only this scene's rollout has."""
    first, second = 5 + number % 20, 30 + number // 20
    return parse_plan(
        f"- longitudinal\n  - 0.0s-{format_tick(first)}s: Keep Speed\n"
        f"  - {format_tick(first)}s-{format_tick(second)}s: Accelerate\n"
        f"  - {format_tick(second)}s-6.4s: Keep Speed\n"
        "- lateral\n  - 0.0s-6.4s: Straight\n- lane\n  - 0.0s-6.4s: Keep Lane\n"
    )


class CountingTeacher:
    """Leaks at every third question's first answer, is busy now and then, and counts what it is asked."""

    def __init__(self) -> None:
        self.answered: list[tuple[str, str, int]] = []
        self.asked = threading.Condition()
        self.asks = 0
        self._luck = random.Random(0)

    def app(self) -> FastAPI:
        app = FastAPI()

        @app.post("/v1/chat/completions")
        async def complete(request: Request) -> Response:
            try:
                body: dict[str, Any] = json.loads(await request.body())
            except ClientDisconnect:
                return Response(status_code=499)
            text = next(part["text"] for part in body["messages"][1]["content"] if "Your plan:" in str(part))
            plan = text.split("Your plan:\n")[1]
            with self.asked:
                self.asks += 1
                self.asked.notify_all()
            await asyncio.sleep(self._luck.uniform(0.0, 0.01))
            if self._luck.random() < 0.1:
                return Response("later", 429, {"Retry-After": "0.01"})
            attempt = 1 if body["seed"] == 0 else 2
            self.answered.append((request.headers["Authorization"], plan, attempt))
            leaks = attempt == 1 and hash_of(plan)[0] in "01234"
            return JSONResponse(completion(LEAKING if leaks else GOOD))

        return app

    def wait_for(self, more: int) -> None:
        """Until so many more questions have come."""
        with self.asked:
            wanted = self.asks + more
            assert self.asked.wait_for(lambda: self.asks >= wanted, PATIENCE_S)


def test_nothing_is_lost_and_nothing_is_paid_twice(tmp_path: Path) -> None:
    file, folder = scenes(tmp_path, SCENES), tmp_path / "build"
    with Ledger(folder) as ledger:
        rollout = ledger.run("rollout", rollout_config(MODEL, Sampling(n=2)))
        keys = []
        for number in range(SCENES):
            scene = named(labelled("scene"), f"scene-{number:04d}")
            keys.append(key_of(rollout, scene))
            record = rollout_record()
            record["free"][0]["plan"] = str(own_plan(number))
            ledger.finish(rollout, keys[-1], scene.scene.scene_id, record)
        ledger.select(rollout, [(key, (0,)) for key in keys])
        label = ledger.run("label", config_of(rollout, OpenAiTeacher(OpenAiSettings("", "some-vlm")), 0))
        plan_of = {
            job.key: str(job.subject.question.predicted)
            for job in jobs(label, questions(ledger, rollout, file))
        }
    assert len(set(plan_of.values())) == SCENES

    def recorded() -> set[tuple[str, int]]:
        with Ledger(folder) as ledger:
            return {
                (plan_of[key], attempt)
                for key in plan_of
                for attempt in range(1, 1 + len(ledger.answers(key)))
            }

    luck, teacher = random.Random(1), CountingTeacher()
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["tests.clients.labelling.killed"])
    recorded_before: dict[str, set[tuple[str, int]]] = {}
    with listening(teacher.app()) as (url, _):
        for life in range(KILLS):
            recorded_before[f"Bearer life {life}"] = recorded()
            process = processes.Process(target=label_all, args=(folder, file, url, f"life {life}"))
            process.start()
            teacher.wait_for(luck.randint(1, 7))
            threading.Event().wait(luck.uniform(0.0, 0.02))
            process.kill()
            process.join(PATIENCE_S)
            assert process.exitcode == -signal.SIGKILL, "it was to be killed in the middle of its work"
        recorded_before["Bearer last"] = recorded()
        label_all(folder, file, url, "last")

    for who, before in recorded_before.items():
        asked = [(plan, attempt) for at, plan, attempt in teacher.answered if at == who]
        assert not before & set(asked), "what was recorded was asked again"
        assert len(set(asked)) == len(asked), "one life asked twice"
    with Ledger(folder) as ledger:
        assert (ledger.count(label, "done"), ledger.count(label, "dead")) == (SCENES, 0)
        entries = list(ledger.entries(label))
        assert {entry.record["predicted_plan"] for entry in entries} == set(plan_of.values())
        assert all(entry.record["reflection"] == GOOD for entry in entries)
        attempts = {entry.record["predicted_plan"]: entry.record["attempts"] for entry in entries}
        assert set(attempts.values()) == {1, 2}
        assert ledger.spent(label).answers == sum(attempts.values())
    # An answer that was on its way when the process died is all that can be paid again.
    assert 0 <= len(teacher.answered) - sum(attempts.values()) <= KILLS * AT_ONCE
