"""The command, as a runtime's container runs it."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import grpc
import pytest
from carla_driver_interface.protocol import EgodriverServiceStub, Empty
from typer.testing import CliRunner

from looktwice.service.cli.commands import app
from looktwice.service.operations.settings import Settings
from tests.clients.alpasim.driving import READY_US, close, drive, observe, start
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import serve
from tests.sockets import PATIENCE_S

RUNNER = CliRunner()


@contextmanager
def running(*arguments: str, **environment: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The command's process and the address it listens on."""
    command = [sys.executable, "-m", "looktwice.service.cli", "egodriver", *arguments]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env={**os.environ, **environment})
    try:
        assert process.stderr is not None
        found = None
        for line in process.stderr:
            if found := re.match(r"listening on (\S+)", line):
                break
        assert found is not None
        yield process, found[1]
    finally:
        process.kill()
        process.communicate(timeout=PATIENCE_S)


def test_it_plans_in_its_own_process_and_ends_when_its_sessions_do(tmp_path: Path) -> None:
    host = f"unix://{tmp_path}/driver.sock"
    with running("--n", "2", "--deadline-ms", "0", ALPASIM_DRIVER_HOST=host) as (process, address):
        assert address == host
        with grpc.insecure_channel(address) as channel:
            stub = EgodriverServiceStub(channel)  # type: ignore[no-untyped-call]  # generated
            assert "looktwice-nano" in stub.get_version(Empty()).version_id
            start(stub, "one")
            observe(stub, "one")
            assert len(drive(stub, "one").debug_info.sampled_trajectories) == 2
            process.send_signal(signal.SIGTERM)
            # A session that is open is driven on.
            assert len(drive(stub, "one", READY_US).trajectory.poses) == 65
            close(stub, "one")
        assert process.wait(PATIENCE_S) == 0


def test_it_plans_through_a_service_on_the_port_that_the_environment_says() -> None:
    with (
        serve(ScriptedEngine(), Settings()) as served,
        running("--service", served.url, ALPASIM_DRIVER_PORT="0") as (process, address),
        grpc.insecure_channel(address) as channel,
    ):
        stub = EgodriverServiceStub(channel)  # type: ignore[no-untyped-call]  # generated
        start(stub, "one")
        observe(stub, "one")
        assert drive(stub, "one").trajectory.poses
        close(stub, "one")
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--camera", "front=x", "--camera", "above=y"], "'above=y' is not OURS=LOGICAL_ID"),
        (["--service", "http://127.0.0.1:1"], "ConnectError"),
        (["--port", "65536"], "65535"),
    ],
)
def test_it_says_what_is_wrong(arguments: list[str], message: str) -> None:
    result = RUNNER.invoke(app, ["egodriver", *arguments])
    assert result.exit_code == 2
    assert message in result.stderr
