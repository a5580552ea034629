"""Dependency arrows point one way (docs/architecture.md): read from the code's own imports."""

from __future__ import annotations

import ast
import functools
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest


def within(name: str, places: tuple[str, ...]) -> bool:
    return any(name == each or name.startswith(each + "/") for each in places)


ROOT = Path(__file__).parent.parent
PACKAGES = ("model", "service", "clients", "loadtests", "deploy")
EVERYTHING = PACKAGES
SIMULATOR = "clients/metadrive/simulator"
WIRE = (
    *("clients/wire", "clients/wire_feedback", "clients/wire_imagine", "clients/wire_refine"),
    *("clients/wire_scores", "clients/wire_values"),
)
ENGINES = (
    *("model/engines/engine", "model/network/model_card", "model/families", "model/formats"),
    "model/driving",
)
"""What an engine is asked and answers, whichever it is."""
ALLOWED = {
    "model": ("model",),
    "model/driving": ("model/driving",),
    "model/formats": ("model/formats", "model/driving"),
    "model/families": ("model/families", "model/formats", "model/driving"),
    "model/network": ("model/network", "model/families", "model/formats", "model/driving"),
    "model/engines": ("model/engines", "model/network", "model/families", "model/formats", "model/driving"),
    "model/evaluation": (
        *("model/evaluation", "model/engines", "model/network", "model/families", "model/driving"),
    ),
    "model/training": (
        *("model/training", "model/evaluation", "model/engines", "model/network", "model/families"),
        *("model/formats", "model/driving"),
    ),
    "model/training/outcome": (
        *("model/training", "model/engines", "model/network", "model/families", "model/formats"),
        "model/driving",
    ),
    "clients": ("clients", "model/driving"),
    "clients/summaries": ("clients/summaries", "model/driving"),
    "clients/metadrive": (),
    "clients/metadrive/simulator": (),
    "clients/metadrive/result_store": (),
    "clients/metadrive/world": ("clients/metadrive/world", SIMULATOR, "model/driving"),
    "clients/metadrive/drawing": (
        *("clients/metadrive/drawing", "clients/metadrive/world", SIMULATOR, "model/driving"),
    ),
    "clients/metadrive/scenes": (
        *("clients/metadrive/scenes", "clients/metadrive/drawing", "clients/metadrive/world"),
        "model/driving",
    ),
    "clients/metadrive/closed_loop": (
        *("clients/metadrive/closed_loop", "clients/metadrive/scenes", "clients/metadrive/drawing"),
        *("clients/metadrive/world", "clients/metadrive/result_store"),
        *("clients/summaries", "clients/planner", "clients/wire", "clients/wire_imagine", "model/driving"),
    ),
    "clients/metadrive/generation": (
        *("clients/metadrive/generation", "clients/metadrive/closed_loop", "clients/metadrive/scenes"),
        *("clients/metadrive/drawing", "clients/metadrive/world", SIMULATOR, "model/driving"),
    ),
    "clients/metadrive/outcomes": (
        *("clients/metadrive/outcomes", "clients/metadrive/generation", "clients/metadrive/scenes"),
        *("clients/metadrive/world", "clients/metadrive/result_store", SIMULATOR, "model/driving"),
    ),
    "clients/importers": ("clients/importers", "clients/navsim", "model/driving"),
    "loadtests": ("loadtests", "clients", "model/driving"),
    "service": (),
    "service/problems": ("clients/wire",),
    "service/admission": ("service/admission", "service/problems"),
    "service/operations": (
        *("service/operations", "service/admission", "service/problems", "clients/wire"),
        *("clients/labelling/teachers", "model/bundled", *ENGINES),
    ),
    "service/http": (
        *("service/http", "service/operations", "service/problems", "clients/wire", "clients/wire_values"),
    ),
    "service/inspector": ("service/inspector", "service/http", "service/problems"),
    "service/scenes": (
        *("service/scenes", "service/problems", "clients/wire", "clients/wire_values", "model/driving"),
    ),
    "service/scoring": (
        *("service/scoring", "service/scenes", "service/problems", *WIRE),
        *("clients/labelling/teachers", "model/driving"),
    ),
    "service/planning": (
        *("service/planning", "service/scoring", "service/operations", "service/admission"),
        *("service/problems", *WIRE, *ENGINES),
    ),
    "service/openai": (
        *("service/openai", "service/planning", "service/problems", "clients/wire", *ENGINES),
    ),
    "service/teaching": (
        *("service/teaching", "service/planning", "service/scoring", "service/operations"),
        *("service/problems", *WIRE, "clients/labelling/teachers", "clients/retries"),
        "model/driving",
    ),
    "service/routes": (
        *("service/routes", "service/teaching", "service/openai", "service/planning", "service/scoring"),
        *("service/scenes", "service/http", "service/operations", "service/admission", "service/problems"),
        *(*WIRE, "clients/labelling/teachers", "model/driving", "model/engines/engine"),
    ),
    "service/app": (
        *("service/routes", "service/inspector", "service/planning", "service/scoring", "service/http"),
        *("service/operations", "service/admission", "clients/wire", "clients/labelling/teachers"),
        "model/engines/engine",
    ),
    "service/cli": EVERYTHING,
    "deploy": ("deploy", "service", "model/bundled"),
}
SERVICE = tuple(room for room in ALLOWED if room.startswith("service/") and room != "service/cli")
"""From the lowest to the highest."""
METADRIVE = tuple(room for room in ALLOWED if within(room, ("clients/metadrive",)))
DOORS = (*("clients/metadrive/closed_loop", "clients/metadrive/generation", "clients/metadrive/outcomes"),)
TORCH_FREE = ("model/driving", "model/formats", "model/families", "clients", "loadtests", *SERVICE)
AT_THE_DOOR = ("service/app", "service/http", "service/inspector", "service/routes")
"""Where requests and answers are HTTP's."""
LIGHT = (*WIRE, "clients/planner")
LIGHT_IMPORTS = ("numpy", "PIL", "httpx", "httpx_sse", "msgpack", "pydantic", "model", "clients")


def modules() -> Iterator[tuple[str, Path]]:
    """Where modules are, as `ALLOWED` tells it: packages are folders, others files without their ending."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            place = path.relative_to(ROOT).with_suffix("")
            yield (place.parent if place.name == "__init__" else place).as_posix(), path


@functools.cache
def imports(path: Path) -> tuple[str, ...]:
    found = list[str]()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute here"
            found += [_imported(node.module or "", alias.name) for alias in node.names]
    return tuple(found)


def _imported(module: str, name: str) -> str:
    """What ``from module import name`` brings in: a module of ours where the name is one."""
    whole = f"{module}.{name}"
    path = ROOT / place(whole)
    ours = module.startswith("looktwice.") and (path.is_dir() or path.with_suffix(".py").exists())
    return whole if ours else module


def place(imported: str) -> str:
    """As `ALLOWED` tells it."""
    return imported.removeprefix("looktwice.").replace(".", "/")


@pytest.mark.parametrize(("name", "path"), list(modules()))
def test_arrows_point_one_way(name: str, path: Path) -> None:
    room = max((room for room in ALLOWED if within(name, (room,))), key=len)
    ours = [place(imported) for imported in imports(path) if imported.startswith("looktwice.")]
    assert [imported for imported in ours if not within(imported, ALLOWED[room])] == []


@pytest.mark.parametrize("house", [SERVICE, METADRIVE])
def test_rooms_stand_on_lower_ones(house: tuple[str, ...]) -> None:
    higher = [
        (room, each)
        for number, room in enumerate(house)
        for each in ALLOWED[room]
        if each in house and each not in house[: number + 1]
    ]
    assert higher == []


@pytest.mark.parametrize("house", ["service", "clients/metadrive"])
def test_every_folder_is_a_room(house: str) -> None:
    folders = {path.parent.relative_to(ROOT).as_posix() for path in (ROOT / house).glob("*/__init__.py")}
    assert folders <= ALLOWED.keys()


def outsiders() -> Iterator[Path]:
    """Whoever uses scenes and drives of the simulator without being a part of it; examples too."""
    yield from (path for name, path in modules() if not within(name, ("clients/metadrive",)))
    yield from (ROOT / "docs").rglob("*.py")


def test_others_come_to_the_simulator_by_its_doors() -> None:
    entered = {
        place(imported)
        for path in outsiders()
        for imported in imports(path)
        if within(place(imported), ("clients/metadrive",))
    }
    assert entered == {*DOORS}


@pytest.mark.parametrize("door", DOORS)
def test_a_door_needs_no_simulator(door: str) -> None:
    blocked = (
        "import sys; sys.modules.update(dict.fromkeys(('metadrive', 'panda3d', 'direct', 'gltf'))); "
        f"import looktwice.{door.replace('/', '.')}"
    )
    subprocess.run([sys.executable, "-c", blocked], check=True, cwd=ROOT)


@pytest.mark.parametrize(("name", "path"), list(modules()))
def test_http_stays_at_the_door(name: str, path: Path) -> None:
    if within(name, SERVICE) and not within(name, AT_THE_DOOR):
        door = [each for each in imports(path) if within(place(each), ("fastapi", "starlette", "uvicorn"))]
        assert door == []


def test_nobody_imports_a_room_by_another_name() -> None:
    everywhere = [path for folder in (*PACKAGES, "docs", "tests") for path in (ROOT / folder).rglob("*.py")]
    assert len(everywhere) > len(list(modules()))
    assert [
        path
        for path in everywhere
        if any(within(place(each), PACKAGES) and not each.startswith("looktwice.") for each in imports(path))
    ] == []


@pytest.mark.parametrize("package", PACKAGES)
def test_a_room_in_reach_says_by_which_name_to_import_it(package: str) -> None:
    """In a clone's root they are in reach; two names would be two modules of everything."""
    done = subprocess.run(
        [sys.executable, "-c", f"import {package}"], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 1
    assert done.stderr.endswith(f"ImportError: {package} is looktwice.{package}; import it by that name\n")


@pytest.mark.parametrize(("name", "path"), list(modules()))
def test_torch_stays_in_the_engine_room(name: str, path: Path) -> None:
    if within(name, TORCH_FREE):
        heavy = [each for each in imports(path) if within(place(each), ("torch", "transformers"))]
        assert heavy == []


@pytest.mark.parametrize(("name", "path"), list(modules()))
def test_the_planner_client_stays_light(name: str, path: Path) -> None:
    if within(name, LIGHT):
        foreign = [
            imported
            for imported in imports(path)
            if imported.split(".")[0] not in sys.stdlib_module_names
            and not within(place(imported), LIGHT_IMPORTS)
        ]
        assert foreign == []


def test_the_planner_client_needs_none_of_the_heavy_packages() -> None:
    heavy = (
        "torch",
        "transformers",
        "pyarrow",
        "fastapi",
        "pydantic_settings",
        "matplotlib",
        "shapely",
        "typer",
    )
    blocked = f"import sys; sys.modules.update(dict.fromkeys({heavy!r})); import looktwice.clients.planner"
    subprocess.run([sys.executable, "-c", blocked], check=True, cwd=ROOT)


def test_the_command_says_what_to_install_where_only_the_client_is() -> None:
    script = "import sys; sys.modules['typer'] = None; from looktwice.service.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 1
    assert "pip install 'looktwice[serve]'" in done.stderr
