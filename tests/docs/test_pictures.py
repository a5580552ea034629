from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from looktwice.model.bundled import CHECKPOINT
from tests.browser.pictures import FOLDER, IMAGINED, IMAGINING, INSPECTOR, KEY, PLAN, revision


@pytest.mark.parametrize(
    ("path", "checkpoint"),
    [(PLAN, CHECKPOINT), (INSPECTOR, CHECKPOINT), (IMAGINED, IMAGINING)],
    ids=lambda path: str(path.name),
)
def test_pictures_show_the_checkpoint_that_is_shipped(path: Path, checkpoint: Path) -> None:
    with Image.open(path) as picture:
        assert picture.info.get(KEY) == revision(checkpoint), "make pictures"


def test_no_picture_is_made_by_hand() -> None:
    assert set(FOLDER.iterdir()) == {PLAN, INSPECTOR, IMAGINED}
