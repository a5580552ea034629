"""`make test-readme`: the README and docs/own-cameras.md followed to the letter in a clean clone.

It clones the commit that is checked out and runs every block of commands in order, against the real service.
The README's Python runs in an environment that holds nothing but what the README names. Of every command that
README and docs/commands.md list it asks for the help, and those that take seconds it runs (`TRIED`). This
takes a network and minutes. Nothing but Python is needed, since the environments are made on the way.

`make test` follows the pages' own commands too, without a network: see `follow_without_network`.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from itertools import product, takewhile
from pathlib import Path
from typing import Final
from urllib.error import URLError
from urllib.request import urlopen

ROOT: Final = Path(__file__).parents[2]
COMMANDS: Final = "docs/commands.md"
PORT: Final = 8000
ELSEWHERE: Final = {"make test": "continuous integration runs it in a clean clone anyway; half an hour"}
"""Commands that are not run, and why."""
_VIDEO: Final = "pip install -c constraints.txt -e '.[video]'"
MINUTE: Final = (
    "looktwice scenes import tests/data/comma2k19/segment_40 minute.parquet --route",
    "looktwice plan minute.parquet --limit 1",
)
_SCENES: Final = "model/bundled/scenes.parquet"
TRIED: Final = {
    "serve": "looktwice serve --settings",
    "scenes stats": "looktwice scenes stats",
    "scenes show": "looktwice scenes show --limit 2",
    "scenes pick": f"looktwice scenes pick {_SCENES} out/picked.parquet --count 2",
    "scenes short-term": f"looktwice scenes short-term {_SCENES} {_SCENES}",
    "build rollout": f"looktwice build rollout out/build {_SCENES} --service http://localhost:{PORT} --n 1",
    "build filter": "looktwice build filter out/build --everything",
    "build label": f"looktwice build label out/build {_SCENES}",
    "build export": "looktwice build export out/build --to out/reflections.parquet",
    "describe": "cp -r model/bundled/looktwice-nano out/nano && looktwice describe out/nano",
    "blend": "looktwice blend model/bundled/looktwice-nano out/nano --to out/between",
    "keys new": "looktwice keys new somebody",
    "evaluate": "looktwice evaluate --limit 2 --n 1",
}
"""How listed commands are run beside the README's service, in this order."""
HELP_ONLY: Final = {
    "plan": "the README's `make plan` runs it",
    "scenes generate": "it needs the simulator",
    "scenes import": "docs/own-cameras.md runs it",
    "train": "minutes to hours",
    "train create": "minutes",
    "build outcomes": "it needs the simulator",
    "build take": "it needs answers of the Batch API",
    "score": "docs/scoring.md has its examples",
    "feedback": "docs/feedback.md has its examples",
    "failures": "it needs a checkpoint of ELF-VLA",
    "drive": "it needs the simulator",
    "loadtest": "a busy machine makes its run not valid, which is an exit code of 1",
    "egodriver": "it serves until it is ended",
    "bench engine": "minutes",
    "bench precision": "minutes",
    "bench egodriver": "minutes",
    "bench http": "minutes",
    "bench score": "minutes",
}
"""Listed commands of which only the help is asked for, and why."""
ACTIVATE: Final = "source .venv/bin/activate"
SERVE: Final = "looktwice serve"
_READY_S: Final = 120.0
_LONGEST_S: Final = 1800.0
_STOP_S: Final = 60.0
_COLUMNS: Final = 200
"""So that no option's name is cut in a help text."""


class Faulty(Exception):
    """A command that does not do what the page says."""


def blocks(page: str) -> list[tuple[str, str]]:
    """Language and text of a page's fenced blocks."""
    return re.findall(r"^```(\w*)\n(.*?)^```", page, re.S | re.M)


def lines(block: str) -> list[str]:
    """A block's commands: without comments, continued lines joined."""
    bare = (re.sub(r"\s+#.*", "", line) for line in block.replace("\\\n", " ").splitlines())
    return [" ".join(line.split()) for line in bare if line.strip()]


def listed(page: str) -> list[tuple[str, list[str]]]:
    """The `looktwice` commands in a page's text, alternatives one by one, and the options it shows."""
    text = re.sub(r"^```.*?^```", "", page, flags=re.S | re.M).replace("\\|", "|")
    found = []
    for words in re.findall(r"`looktwice ([^`]+)`", text):
        names = takewhile(lambda word: re.fullmatch(r"[a-z|-]+", word) and word[0] != "-", words.split())
        options = re.findall(r"--[a-z-]+", words)
        found += [(" ".join(each), options) for each in product(*(name.split("|") for name in names))]
    return found


class Newcomer:
    """Somebody in a folder, with a shell that remembers whether the environment was activated."""

    def __init__(
        self, folder: Path, port: int = PORT, left_out: Mapping[str, str] = ELSEWHERE, *, network: bool = True
    ) -> None:
        self.folder, self.port, self.left_out, self.network = folder, port, left_out, network
        self.activated, self.longest_s = False, _LONGEST_S

    def environment(self) -> dict[str, str]:
        kept = {
            name: value
            for name, value in os.environ.items()
            if name not in ("VIRTUAL_ENV", "PYTHONPATH") and not name.startswith("LOOKTWICE_")
        }
        venv = Path(sys.prefix)
        paths = [path for path in kept["PATH"].split(":") if Path(path) != venv / "bin"]
        if self.activated:
            paths.insert(0, str(self.folder / ".venv" / "bin"))
        return kept | {"PATH": ":".join(paths), "COLUMNS": str(_COLUMNS)}

    def run(self, command: str, *, folder: Path | None = None) -> str:
        """Run a command to its end and say how long it took.

        Raises:
            Faulty: it fails, or takes too long; with it ends what it started.
        """
        began = time.monotonic()
        with subprocess.Popen(
            ["bash", "-c", command],
            cwd=folder or self.folder,
            env=self.environment(),
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        ) as running:
            try:
                told, _ = running.communicate(timeout=self.longest_s)
            except subprocess.TimeoutExpired:
                raise Faulty(f"{command}\nis not done within {self.longest_s:.0f} s") from None
            finally:
                if running.returncode is None:
                    os.killpg(running.pid, signal.SIGKILL)
        print(f"{time.monotonic() - began:6.1f} s  {command.splitlines()[0][:110]}", flush=True)
        if running.returncode:
            raise Faulty(f"{command}\nended with {running.returncode}:\n{told[-3000:]}")
        return told

    @contextmanager
    def service(self) -> Iterator[None]:
        """The service, started as the README says; ended as Ctrl-C ends it."""
        began = time.monotonic()
        elsewhere = [] if self.port == PORT else ["--port", str(self.port)]
        with tempfile.TemporaryFile("w+") as log:
            running = subprocess.Popen(
                [*SERVE.split(), *elsewhere],
                cwd=self.folder,
                env=self.environment(),
                stdout=log,
                stderr=log,
            )
            try:
                while not _is_ready(self.port):
                    if running.poll() is not None or time.monotonic() - began > _READY_S:
                        log.seek(0)
                        raise Faulty(f"{SERVE} does not get ready:\n{log.read()[-3000:]}")
                    time.sleep(0.2)
                print(f"{time.monotonic() - began:6.1f} s  {SERVE}, until it is ready", flush=True)
                yield
            finally:
                running.send_signal(signal.SIGINT)
                code = running.wait(_STOP_S)
        if code:
            raise Faulty(f"{SERVE} ended with {code}")


def _is_ready(port: int) -> bool:
    try:
        with urlopen(f"http://localhost:{port}/readyz", timeout=5) as answer:
            return bool(answer.status == 200)
    except (URLError, OSError):
        return False


def run_block(newcomer: Newcomer, block: str) -> None:
    """A block of commands, one after the other."""
    for command in lines(block.replace(f"localhost:{PORT}", f"localhost:{newcomer.port}")):
        if command == ACTIVATE:
            newcomer.run(command)
            newcomer.activated = True
        elif command == SERVE or command in newcomer.left_out:
            continue
        else:
            asks = command.startswith("curl -s ")
            told = newcomer.run(command.replace("curl -s ", "curl -s --fail-with-body ", 1))
            if asks and '"draws"' not in told:
                raise Faulty(f"{command}\nanswers without draws:\n{told[:1000]}")


def follow_readme(newcomer: Newcomer) -> None:
    """Everything in the README."""
    page = (newcomer.folder / "README.md").read_text()
    rest = [(language, block) for language, block in blocks(page) if language in ("bash", "python")]
    while not newcomer.activated:
        run_block(newcomer, rest.pop(0)[1])
    assert rest, "nothing behind the service"
    lists = page + (newcomer.folder / COMMANDS).read_text()
    if newcomer.network:
        check_pins(newcomer)
        for command, options in listed(lists):
            told = newcomer.run(f"looktwice {command} --help")
            if missing := [option for option in options if option not in told]:
                raise Faulty(f"looktwice {command} has no {', '.join(missing)}")
    for target in sorted(set(re.findall(r"`make ([a-z-]+)`", lists))):
        newcomer.run(f"make --dry-run {target}")
    with newcomer.service():
        if newcomer.network:
            run_block(newcomer, "\n".join(TRIED.values()))
        for language, block in rest:
            if language == "bash":
                run_block(newcomer, block)
            else:
                run_python(newcomer, block)


def check_pins(newcomer: Newcomer) -> None:
    """Everything that was installed has its version in constraints.txt."""
    pinned = {_package(line) for line in (newcomer.folder / "constraints.txt").read_text().splitlines()}
    installed = newcomer.run("pip list --format=freeze --exclude-editable --disable-pip-version-check")
    loose = (
        {_package(line) for line in installed.splitlines() if "==" in line} - pinned - {"pip", "setuptools"}
    )
    if loose:
        raise Faulty(f"not pinned in constraints.txt: {', '.join(sorted(loose))}")


def _package(line: str) -> str:
    return re.sub(r"[-_.]+", "-", line.partition("==")[0]).lower()


def run_python(newcomer: Newcomer, code: str) -> None:
    """A snippet outside the clone; where there is a network, in an environment with the client alone."""
    folder = newcomer.folder.parent / "client"
    if not newcomer.network:
        folder.mkdir(exist_ok=True)
        if not (folder / ".venv").exists():
            (folder / ".venv").symlink_to(newcomer.folder / ".venv")
    elif not folder.exists():
        newcomer.run(f"python3 -m venv {folder}/.venv")
        newcomer.run(f"{folder}/.venv/bin/pip install --quiet -c constraints.txt . pyarrow")
    (folder / "snippet.py").write_text(code.replace(f"localhost:{PORT}", f"localhost:{newcomer.port}"))
    told = newcomer.run(".venv/bin/python snippet.py", folder=folder)
    if "done" not in told:
        raise Faulty(f"the snippet says:\n{told[-1000:]}")


def follow_own_cameras(newcomer: Newcomer) -> None:
    """Every command of docs/own-cameras.md."""
    for language, block in blocks((newcomer.folder / "docs" / "own-cameras.md").read_text()):
        if language == "bash":
            run_block(newcomer, block)


def follow_without_network(folder: Path, port: int) -> None:
    """Both pages in a copy of what git carries here, with the packages that run this.

    Not tried: the commands that are `left_out`, and those that the README only lists, which have tests of
    their own; that `make plan` installs; that the client needs no more than it names, and that
    constraints.txt pins all.

    Raises:
        Faulty: a command does not do what the page says.
    """
    newcomer = Newcomer(folder / "looktwice", port, left_out(), network=False)
    copy_clone(newcomer.folder)
    _installed(newcomer.folder)
    follow_readme(newcomer)
    follow_own_cameras(newcomer)


def copy_clone(folder: Path) -> None:
    """What git carries here, changes that are not committed included, in another folder."""
    listed_files = ("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard")
    names = subprocess.run(listed_files, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, names.split("\0")):
        if (ROOT / name).is_file() or (ROOT / name).is_symlink():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name, follow_symlinks=False)


def left_out() -> dict[str, str]:
    """Commands of both pages that are not run without a network, and why."""
    films = {} if find_spec("cv2") else dict.fromkeys(MINUTE, "OpenCV, which reads films, is not installed")
    return ELSEWHERE | {_VIDEO: "it downloads packages"} | films


def _installed(clone: Path) -> None:
    """Give a clone the environment that `make plan` would: this one's packages, the clone's own modules."""
    venv = clone / ".venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", venv], check=True)
    (packages,) = venv.glob("lib/python*/site-packages")
    (packages / "clone.pth").write_text(f"{clone / 'src'}\n{sysconfig.get_path('purelib')}\n")
    command = venv / "bin" / "looktwice"
    command.write_text(f"#!{venv}/bin/python\nfrom looktwice.service.cli import main\nmain()\n")
    command.chmod(0o755)
    for stage in (".created", ".torch", ".serve"):  # of the Makefile, in order
        (venv / stage).touch()


def main() -> None:
    """Follow both pages; the exit status says whether all went as they say."""
    with socket.socket() as probe:
        if not probe.connect_ex(("localhost", PORT)):
            sys.exit(f"something listens at port {PORT} already")
    with tempfile.TemporaryDirectory() as folder:
        newcomer = Newcomer(Path(folder))
        try:
            newcomer.run(f"git clone --quiet {ROOT} looktwice")
            newcomer.folder /= "looktwice"
            follow_readme(newcomer)
            began = time.monotonic()
            follow_own_cameras(newcomer)
            print(f"{time.monotonic() - began:6.1f} s  docs/own-cameras.md in all", flush=True)
        except Faulty as fault:
            sys.exit(str(fault))


if __name__ == "__main__":
    main()
