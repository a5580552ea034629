"""The site of docs/ is built as `make docs` does."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

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


def test_links_that_lead_nowhere_fail_the_site(tmp_path: Path) -> None:
    links = ("nobody.md", "index.md#nowhere", "/no-place")
    settings = (ROOT / "mkdocs.yml").read_text()
    (tmp_path / "mkdocs.yml").write_text(settings[: settings.index("nav:\n  - ")])
    (tmp_path / "docs").mkdir()
    page = "\n".join(f"[a link]({link})" for link in links)
    (tmp_path / "docs" / "index.md").write_text(f"# Home\n\n{page}\n")
    done = build(tmp_path, tmp_path / "site")
    assert done.returncode != 0
    assert [link for link in links if f"'{link}'" not in done.stderr] == []
