"""The site of docs/ is built as `make docs` does."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
BUILD = (sys.executable, "-m", "mkdocs", "build")


def build(folder: Path, out: Path) -> subprocess.CompletedProcess[str]:
    command = [*BUILD, "--config-file", str(folder / "mkdocs.yml"), "--site-dir", str(out)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_every_page_is_in_the_site_and_every_link_leads_somewhere(tmp_path: Path) -> None:
    done = build(ROOT, tmp_path / "site")
    assert done.returncode == 0, done.stdout + done.stderr
    for page in (ROOT / "docs").glob("*.md"):
        name = "index.html" if page.stem == "index" else f"{page.stem}/index.html"
        assert (tmp_path / "site" / name).is_file()


@pytest.mark.parametrize("link", ["nowhere.md", "index.md#nowhere", "/nowhere"])
def test_a_link_that_leads_nowhere_fails_the_site(link: str, tmp_path: Path) -> None:
    settings = (ROOT / "mkdocs.yml").read_text()
    (tmp_path / "mkdocs.yml").write_text(settings[: settings.index("nav:\n  - ")])
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "index.md").write_text(f"# Home\n\n[a link]({link})\n")
    done = build(tmp_path, tmp_path / "site")
    assert done.returncode != 0
    assert "nowhere" in done.stderr
