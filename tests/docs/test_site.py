"""The site of docs/ is built as `make docs` does."""

from __future__ import annotations

import html
import re
import subprocess
import sys
from pathlib import Path

import pytest

from looktwice.clients import planner

ROOT = Path(__file__).parents[2]
BUILD = (sys.executable, "-m", "mkdocs", "build")


def build(folder: Path, out: Path) -> subprocess.CompletedProcess[str]:
    command = [*BUILD, "--config-file", str(folder / "mkdocs.yml"), "--site-dir", str(out)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Whose every link leads somewhere."""
    out = tmp_path_factory.mktemp("site")
    done = build(ROOT, out)
    assert done.returncode == 0, done.stdout + done.stderr
    return out


def page_of_its_own(folder: Path, page: str) -> None:
    """A site of one page in a folder, with our settings."""
    settings = (ROOT / "mkdocs.yml").read_text()
    (folder / "mkdocs.yml").write_text(settings[: settings.index("nav:\n  - ")])
    (folder / "docs").mkdir()
    (folder / "docs" / "index.md").write_text(f"# Home\n\n{page}\n")


def documented(site: Path, page: str) -> dict[str, str]:
    """What a page of the reference says of each Python name, as text."""
    built = (site / "reference" / page / "index.html").read_text()
    _, *found = re.split(r'<h\d id="(looktwice\.[\w.]+)"', built[: built.index("<footer>")])
    texts = (" ".join(re.sub("<[^>]*>", "", f"<{told}").split()) for told in found[1::2])
    return {name: html.unescape(text) for name, text in zip(found[::2], texts, strict=True)}


def test_every_page_is_in_the_site(site: Path) -> None:
    docs = ROOT / "docs"
    for page in docs.rglob("*.md"):
        place = page.relative_to(docs).with_suffix("")
        name = "index.html" if place == Path("index") else f"{place}/index.html"
        assert (site / name).is_file()


def test_links_that_lead_nowhere_fail_the_site(tmp_path: Path) -> None:
    links = ("nobody.md", "index.md#nowhere", "/no-place")
    page_of_its_own(tmp_path, "\n".join(f"[a link]({link})" for link in links))
    done = build(tmp_path, tmp_path / "site")
    assert done.returncode != 0
    assert [link for link in links if f"'{link}'" not in done.stderr] == []


@pytest.mark.parametrize(
    ("page", "name", "said"),
    [
        ("clients", "clients.planner.PlannerClient", "of the service, such as"),
        ("clients", "clients.planner.PlannerClient.plan", "scene: Scene, controls: Controls = Controls(), *"),
        ("clients", "clients.planner.PlannerClient.plan", "the first plan, to be continued instead of one"),
        ("clients", "clients.planner.PlannerClient.plan", "see its subclasses."),
        ("clients", "clients.answers.PlannedDraw", "x, y, z in m and heading in rad, ego frame"),
        ("families", "model.families.family.Family", "what the values of a response say."),
        ("families", "model.families.prompts.TextInputs", "numbers must lie on their grid"),
        ("pieces", "model.formats.pieces.FreeText", "whether the text may have several lines"),
        ("pieces", "model.formats.compounds.Number", "low: float, high: float, step: float"),
        ("engines", "model.engines.engine.Engine.submit", "a picture is damaged"),
        ("engines", "model.engines.engine.Controls", "0 takes the likeliest allowed token."),
    ],
)
def test_the_reference_says_what_docstrings_say(site: Path, page: str, name: str, said: str) -> None:
    assert said in documented(site, page)[f"looktwice.{name}"]


def test_the_reference_has_all_that_planner_clients_export(site: Path) -> None:
    assert set(planner.__all__) - {name.rpartition(".")[2] for name in documented(site, "clients")} == set()


@pytest.mark.parametrize("page", ["clients", "families", "pieces", "engines"])
def test_the_reference_is_of_public_names_without_their_code(site: Path, page: str) -> None:
    found = documented(site, page)
    assert not [name for name in found if re.search(r"\._(?!_)", name)]
    assert not [name for name, text in found.items() if "Source code" in text]
    # Such as `x_m, y_m: …` in a docstring, of which the second is taken for the type of the first.
    assert not [name for name, text in found.items() if re.search(r"\w, \(", text)]


def test_arguments_that_are_not_there_fail_the_site(tmp_path: Path) -> None:
    page_of_its_own(tmp_path, "::: looktwice.plan")
    package = tmp_path / "src" / "looktwice"
    package.mkdir(parents=True)
    told = "Plan.\n\n    Args:\n        prefill: the first plan.\n    "
    (package / "__init__.py").write_text(f'def plan(scene: str) -> None:\n    """{told}"""\n')
    done = build(tmp_path, tmp_path / "site")
    assert done.returncode != 0
    assert "'prefill' does not appear in the function signature" in done.stderr
