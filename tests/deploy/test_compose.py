"""Compose: its schema, its mounts, and what Prometheus and Grafana read in their containers."""

from __future__ import annotations

import re
import shutil
from pathlib import Path, PurePosixPath
from typing import Any

import pytest
import yaml

from tests.deploy.tools import DASHBOARD, DEPLOY, run

COMPOSE = DEPLOY / "compose"
FILES = [COMPOSE / "compose.yaml", COMPOSE / "compose.cuda.yaml"]


@pytest.fixture(scope="module")
def services() -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = yaml.safe_load(FILES[0].read_text())["services"]
    return found


def mounts(service: dict[str, Any]) -> dict[PurePosixPath, Path]:
    """Files that a service is given: where it sees them, and where they are."""
    volumes = [volume.split(":") for volume in service.get("volumes", []) if volume.startswith(".")]
    return {PurePosixPath(seen): (COMPOSE / file).resolve() for file, seen, _ in volumes}


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.stem))
def test_files_are_of_the_compose_specification(file: Path) -> None:
    assert "ok" in run("check-jsonschema", "--builtin-schema", "vendor.compose-spec", file)


def test_services_can_do_as_little_as_possible(services: dict[str, dict[str, Any]]) -> None:
    for service in services.values():
        assert service["read_only"] is True
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert all(port.startswith("127.0.0.1:") for port in service["ports"])
        assert re.fullmatch(r"[\w./-]+:v?\d+\.\d+\.\d+(-\w+)?", service["image"])
        assert all(path.is_file() for path in mounts(service).values())


def test_the_image_is_built_from_the_repository(services: dict[str, dict[str, Any]]) -> None:
    build = services["looktwice"]["build"]
    for file in FILES:
        said = build | yaml.safe_load(file.read_text())["services"]["looktwice"]["build"]
        assert (COMPOSE / said["context"] / said["dockerfile"]).is_file()


def test_accepted_requests_are_finished_before_the_container_is_ended(
    services: dict[str, dict[str, Any]],
) -> None:
    service = services["looktwice"]
    assert int(service["environment"]["LOOKTWICE_DRAIN_S"]) < int(service["stop_grace_period"].rstrip("s"))


def test_prometheus_takes_its_files_as_they_are_mounted(
    services: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    for seen, file in mounts(services["prometheus"]).items():
        place = tmp_path / seen.relative_to("/")
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, place)
    config = next(word for word in services["prometheus"]["command"] if word.startswith("--config.file="))
    told = run("promtool", "check", "config", tmp_path / config.removeprefix("--config.file=/"))
    assert re.search(r"SUCCESS: \d+ rules found", told)


def test_prometheus_scrapes_the_service(services: dict[str, dict[str, Any]]) -> None:
    (job,) = yaml.safe_load((COMPOSE / "prometheus.yaml").read_text())["scrape_configs"]
    (target,) = job["static_configs"][0]["targets"]
    name, port = target.split(":")
    assert services[name]["ports"][0].endswith(f":{port}")


def test_grafana_finds_its_source_and_its_dashboard(services: dict[str, dict[str, Any]]) -> None:
    given = mounts(services["grafana"])
    (source,) = yaml.safe_load((COMPOSE / "grafana" / "datasources.yaml").read_text())["datasources"]
    name, port = source["url"].removeprefix("http://").split(":")
    assert services[name]["ports"][0].endswith(f":{port}")
    (provider,) = yaml.safe_load((COMPOSE / "grafana" / "dashboards.yaml").read_text())["providers"]
    home = PurePosixPath(services["grafana"]["environment"]["GF_DASHBOARDS_DEFAULT_HOME_DASHBOARD_PATH"])
    assert str(home.parent) == provider["options"]["path"]
    assert given[home] == DASHBOARD
