from __future__ import annotations

import pytest

from looktwice.model.families.cf_vla import CF_VLA
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.formats.pieces import FormatError
from looktwice.model.formats.text import parse
from tests.model.formats.vocabulary import ByteVocabulary, code_text

COMPILED = CompiledFormat(CF_VLA.format, ByteVocabulary())
PLAN = "- longitudinal\n  - 0.0s-0.9s: Keep Speed\n  - 0.9s-6.4s: Accelerate\n- lateral\n"
PLAN += "  - 0.0s-6.4s: Straight\n- lane\n  - 0.0s-6.4s: Keep Lane\n"
CODES = "".join(code_text(stage, 3) for stage in range(6))
END = f"Action:\n<|traj_future_start|>{CODES}<|traj_future_end|><|im_end|>"
DIRECT = f"Meta Actions:\n{PLAN}{END}"
REFLECTED = f"Meta Actions:\n{PLAN}Thinking:\nA van is ahead.\nMeta Actions:\n{PLAN}{END}"


def test_direct_and_reflected_responses() -> None:
    assert parse(COMPILED, DIRECT)["branch"] == "Action:"
    values = parse(COMPILED, REFLECTED)
    assert values["thinking"] == "A van is ahead."
    assert values["plan"] == values["revised_plan"]
    assert values["trajectory"] == (3,) * 6


@pytest.mark.parametrize(
    ("text", "line", "column", "message"),
    [
        (DIRECT.replace("Meta", "Metre", 1), 1, 1, "expected 'Meta Actions:"),
        (DIRECT.replace("0.9s-6.4s", "1.0s-6.4s"), 4, 5, "gap before"),
        (DIRECT.replace("Accelerate", "Speed Up"), 4, 16, "unknown longitudinal word"),
        (DIRECT.replace("Action:\n<", "Acting:\n<"), 9, 1, "expected one of"),
        (REFLECTED.replace("A van is ahead.", ""), 10, 1, "expected text"),
        (DIRECT.replace(code_text(2, 3), ""), 10, 50, "trajectory code 3 of 6"),
        (DIRECT + "x", 10, 135, "end of the response"),
        ("", 1, 1, "expected 'Meta Actions:"),
    ],
)
def test_errors_name_line_and_column(text: str, line: int, column: int, message: str) -> None:
    with pytest.raises(FormatError, match=message) as caught:
        parse(COMPILED, text)
    assert (caught.value.line, caught.value.column) == (line, column)
