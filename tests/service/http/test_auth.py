from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from looktwice.service.http.auth import OPEN_PATHS
from looktwice.service.operations.keys import Keys, hashed, new_line
from looktwice.service.operations.settings import Settings
from tests.service.http.test_problem_documents import problem
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served, body, serve


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    """The file, an operator's key, a caller's key."""
    (first, line), (second, other) = new_line("operator"), new_line("car-7")
    path = tmp_path_factory.mktemp("keys") / "keys"
    path.write_text(f"# who may ask\n{line}\n\n{other}\n")
    return path, first, second


@pytest.fixture(scope="module")
def guarded(keys: tuple[Path, str, str], scene_file: Path) -> Iterator[Served]:
    settings = Settings(api_keys_file=keys[0], bundled_scenes=scene_file, rate_limit="12/minute")
    bearer = {"Authorization": f"Bearer {keys[1]}"}
    with serve(ScriptedEngine(), settings, headers=bearer) as served:
        yield served


def test_only_hashes_are_kept(keys: tuple[Path, str, str]) -> None:
    path, key, _ = keys
    assert key not in path.read_text()
    assert hashlib.sha256(key.encode()).hexdigest() in path.read_text()
    assert len({new_line("a")[0] for _ in range(5)}) == 5


def test_a_key_belongs_to_its_owner(keys: tuple[Path, str, str]) -> None:
    known = Keys.read(keys[0])
    assert (known.owner(keys[1]), known.owner(keys[2])) == ("operator", "car-7")
    assert known.owner(keys[1] + "x") is None
    assert known.owner("") is None


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "holds no key"),
        ("car-7\n", "line 1"),
        (f"car-7:{hashed('a')}\ncar-7:{hashed('b')}\n", "line 2"),
        ("car-7:plain-text-key\n", "line 1"),
    ],
)
def test_a_keys_file_that_is_none(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "keys").write_text(text)
    with pytest.raises(ValueError, match=reason):
        Keys.read(tmp_path / "keys")


def test_every_route_but_the_probes_is_closed(guarded: Served) -> None:
    described = guarded.http.get("/openapi.json").json()["paths"]
    with httpx.Client(base_url=guarded.url) as stranger:
        for path, operations in described.items():
            for method in operations:
                answer = stranger.request(method, path.replace("{scene_id}", "slow-leader"))
                if path in OPEN_PATHS:
                    assert answer.status_code != 401
                else:
                    problem(answer, "unauthorized")
                    assert answer.headers["WWW-Authenticate"].startswith("Bearer")
        for path in ("/", "/inspector/app.js", "/openapi.json", "/nowhere"):
            problem(stranger.get(path), "unauthorized")


@pytest.mark.parametrize("header", ["", "Bearer", "Bearer x", "Basic !!!", "Basic eDp5", "Digest a"])
def test_strange_credentials(guarded: Served, header: str) -> None:
    problem(httpx.get(guarded.url + "/v1/models", headers={"Authorization": header}), "unauthorized")


def test_browsers_may_give_the_key_as_a_password(guarded: Served, keys: tuple[Path, str, str]) -> None:
    assert httpx.get(guarded.url + "/", auth=("anybody", keys[2])).status_code == 200


def test_rejections_are_counted_and_keys_not_logged(
    guarded: Served, keys: tuple[Path, str, str], capfd: pytest.CaptureFixture[str]
) -> None:
    before = guarded.metric("looktwice_rejections_total", reason="unauthorized")
    httpx.get(guarded.url + "/v1/models", headers={"Authorization": "Bearer secret-guess"})
    assert guarded.metric("looktwice_rejections_total", reason="unauthorized") == before + 1
    guarded.http.get("/v1/models")
    logged = capfd.readouterr().err
    assert "secret-guess" not in logged
    assert keys[1] not in logged


def test_the_description_tells_of_the_key(guarded: Served) -> None:
    described = guarded.http.get("/openapi.json").json()
    assert described["components"]["securitySchemes"]["key"]["scheme"] == "bearer"
    assert described["paths"]["/v1/plan"]["post"]["security"] == [{"key": []}]
    assert "security" not in described["paths"]["/healthz"]["get"]


def test_each_key_has_a_rate_of_its_own(guarded: Served, keys: tuple[Path, str, str]) -> None:
    caller = {"Authorization": f"Bearer {keys[2]}"}
    assert guarded.http.post("/v1/plan", json=body(n=8), headers=caller).status_code == 200
    refused = guarded.http.post("/v1/plan", json=body(n=5), headers=caller)
    assert "4 draws are left" in problem(refused, "rate-limited").detail
    assert 1 <= int(refused.headers["Retry-After"]) <= 60
    assert guarded.http.post("/v1/plan", json=body(n=4), headers=caller).status_code == 200
    assert guarded.http.post("/v1/plan", json=body(n=12)).status_code == 200
    never = guarded.http.post("/v1/plan", json=body(n=13), headers=caller)
    problem(never, "rate-limited")
    assert "Retry-After" not in never.headers


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("localhost", 200),
        ("LOCALHOST:80", 200),
        ("127.0.0.1:8000", 200),
        ("[::1]:8000", 200),
        ("planner.example.com", 421),
        ("localhost.example.com", 421),
        ("", 421),
    ],
)
def test_without_keys_only_known_names_are_answered_to(served: Served, host: str, status: int) -> None:
    answer = served.http.get("/v1/models", headers={"Host": host})
    assert answer.status_code == status
    if status == 421:
        problem(answer, "misdirected")


def test_probes_are_answered_under_any_name(engine: ScriptedEngine) -> None:
    """Docker, the kubelet and Ray ask under addresses that no operator knows beforehand."""
    with serve(engine, Settings(open=True, hosts=frozenset({"127.0.0.1"}))) as served:
        described = served.http.get("/openapi.json").json()["paths"]
        for host in ("10.1.2.3:8000", "replica", ""):
            for path in OPEN_PATHS:
                assert served.http.get(path, headers={"Host": host}).status_code != 421
                assert "421" not in described[path]["get"]["responses"]
            problem(served.http.get("/v1/models", headers={"Host": host}), "misdirected")


def test_a_name_that_is_not_its_own_is_counted_and_not_told_at_length(served: Served) -> None:
    counted = {"reason": "misdirected"}
    before = served.metric("looktwice_rejections_total", **counted)
    for path in ("/metrics", "/v1/scenes", "/v1/chat/completions"):
        answer = served.http.get(path, headers={"Host": "x" * 20_000})
        assert problem(answer, "misdirected").status == 421
        assert len(answer.content) < 1000
        assert ("error" in answer.json()) == path.startswith("/v1/chat")
    assert served.metric("looktwice_rejections_total", **counted) == before + 3


def test_whom_a_service_answers_to_can_be_told(guarded: Served, keys: tuple[Path, str, str]) -> None:
    assert guarded.http.get("/v1/models", headers={"Host": "car.example.com"}).status_code == 200
    assert Settings(open=True).answers_to() is None
    assert Settings(hosts=frozenset({"Car.local"})).answers_to() == frozenset({"car.local"})
    assert Settings(open=True, hosts=frozenset({"car.local"})).answers_to() == frozenset({"car.local"})
