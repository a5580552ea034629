from __future__ import annotations

import pytest
from PIL import Image

from tests.browser.pictures import INSPECTOR, KEY, PLAN, revision


@pytest.mark.parametrize("path", [PLAN, INSPECTOR], ids=lambda path: str(path.name))
def test_pictures_show_the_checkpoint_that_is_shipped(path: object) -> None:
    with Image.open(str(path)) as picture:
        assert picture.info.get(KEY) == revision(), "make pictures"
