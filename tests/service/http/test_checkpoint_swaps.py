"""Another checkpoint takes the place of the one that is served."""

from __future__ import annotations

import threading
from pathlib import Path

import httpx

from looktwice.model.bundled import CHECKPOINT
from looktwice.model.engines.engine import EngineError
from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.service.operations.keys import new_line
from looktwice.service.operations.settings import Settings
from tests.checkpoints import noisy_scene
from tests.service.http.test_problem_documents import problem
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import body, serve


def test_another_checkpoint_takes_over_without_dropping_a_request(
    engine: ScriptedEngine, tmp_path: Path
) -> None:
    (tmp_path / "next").mkdir()
    following = ScriptedEngine()
    following.card_shown = engine.card.__class__(**{**vars(engine.card), "revision": "r2"})
    loaded: list[Path] = []

    def load(path: Path) -> ScriptedEngine:
        loaded.append(path)
        return following

    with serve(engine, Settings(checkpoints=tmp_path), load=load) as served:
        served.in_loop(engine.may_finish.clear)
        answers: list[httpx.Response] = []
        thread = threading.Thread(
            target=lambda: answers.append(httpx.post(served.url + "/v1/plan", json=body(), timeout=30))
        )
        thread.start()
        served.until(lambda: len(engine.submitted) == 1)
        card = served.http.post("/v1/models:load", json={"checkpoint": "next"})
        assert card.json()["revision"] == "r2"
        assert loaded == [tmp_path / "next"]
        after = served.http.post("/v1/plan", json=body())
        assert after.json()["model"]["revision"] == "r2"
        assert not engine.stopped
        served.in_loop(engine.may_finish.set)
        thread.join()
        assert answers[0].json()["model"]["revision"] == "r1"
        served.until(lambda: engine.stopped)
        assert not following.stopped
        assert served.metric("looktwice_checkpoint_swaps_total", outcome="done") == 1
        assert served.metric("looktwice_model_info", revision="r2") == 1
        assert served.metric("looktwice_model_info", revision="r1") == 0


def test_real_engines_change_places_under_load_and_lose_nothing(
    untrained_checkpoint: Path, tmp_path: Path
) -> None:
    (tmp_path / "trained").symlink_to(CHECKPOINT, target_is_directory=True)

    def load(path: Path) -> TorchEngine:
        return TorchEngine(path, TorchSettings(rows=12))

    answers: list[httpx.Response] = []
    enough = threading.Event()

    def ask() -> None:
        while not enough.is_set():
            document = body(noisy_scene(), n=2, thinking="never")
            answers.append(httpx.post(served.url + "/v1/plan", json=document, timeout=60))

    with serve(load(untrained_checkpoint), Settings(checkpoints=tmp_path), load=load) as served:
        before = served.http.get("/v1/models").json()["models"][0]["revision"]
        threads = [threading.Thread(target=ask) for _ in range(2)]
        for thread in threads:
            thread.start()
        served.until(lambda: len(answers) > 3)
        after = served.http.post("/v1/models:load", json={"checkpoint": "trained"}, timeout=60).json()[
            "revision"
        ]
        count = len(answers)
        served.until(lambda: len(answers) > count + 3)
        enough.set()
        for thread in threads:
            thread.join()
    assert [answer.status_code for answer in answers] == [200] * len(answers)
    revisions = [answer.json()["model"]["revision"] for answer in answers]
    assert (revisions[0], revisions[-1]) == (before, after)
    assert before != after


def test_a_checkpoint_that_cannot_be_served_changes_nothing(engine: ScriptedEngine, tmp_path: Path) -> None:
    (tmp_path / "bad").mkdir()

    def load(path: Path) -> ScriptedEngine:
        raise ValueError(f"{path / 'model.safetensors'} has no weights")

    with serve(engine, Settings(checkpoints=tmp_path), load=load) as served:
        refused = served.http.post("/v1/models:load", json={"checkpoint": "bad"})
        detail = problem(refused, "checkpoint-failed").detail
        assert detail == "bad/model.safetensors has no weights", "where checkpoints lie is nobody's business"
        problem(served.http.post("/v1/models:load", json={"checkpoint": "none"}), "unknown-checkpoint")
        for strange in ("../bad", "", "/etc", ".hidden"):
            problem(served.http.post("/v1/models:load", json={"checkpoint": strange}), "invalid-request")
        assert served.http.post("/v1/plan", json=body()).json()["model"]["revision"] == "r1"


def test_a_checkpoint_that_fails_when_it_starts_leaves_no_thread(
    engine: ScriptedEngine, tmp_path: Path, untrained_checkpoint: Path
) -> None:
    (tmp_path / "bad").mkdir()
    before: set[threading.Thread] = set()
    running: set[threading.Thread] = set()

    class Failing(TorchEngine):
        async def start(self) -> None:
            await super().start()
            begun = set(threading.enumerate()) - before
            running.update(thread for thread in begun if thread.name.startswith("looktwice-"))
            raise EngineError("no memory left")

    def load(path: Path) -> TorchEngine:
        before.update(threading.enumerate())
        return Failing(untrained_checkpoint)

    with serve(engine, Settings(checkpoints=tmp_path), load=load) as served:
        refused = served.http.post("/v1/models:load", json={"checkpoint": "bad"}, timeout=60)
        assert "no memory left" in problem(refused, "checkpoint-failed").detail
        assert "looktwice-engine" in {thread.name for thread in running}
        served.until(lambda: not any(thread.is_alive() for thread in running))
        assert served.http.post("/v1/plan", json=body()).json()["model"]["revision"] == "r1"


def test_only_operators_replace_the_checkpoint(engine: ScriptedEngine, tmp_path: Path) -> None:
    (key, line), (other, other_line) = new_line("operator"), new_line("car")
    (tmp_path / "keys").write_text(f"{line}\n{other_line}\n")
    (tmp_path / "next").mkdir()
    settings = Settings(checkpoints=tmp_path, api_keys_file=tmp_path / "keys")
    with serve(
        engine, settings, load=lambda _: ScriptedEngine(), headers={"Authorization": f"Bearer {key}"}
    ) as served:
        car = {"Authorization": f"Bearer {other}"}
        refused = served.http.post("/v1/models:load", json={"checkpoint": "next"}, headers=car)
        problem(refused, "forbidden")
        assert served.http.post("/v1/models:load", json={"checkpoint": "next"}).status_code == 200
