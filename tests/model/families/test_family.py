from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from looktwice.model.families.cf_vla import CF_VLA
from looktwice.model.families.cf_vla.traj_only import TRAJ_ONLY
from looktwice.model.families.family import Branch, FamilyError
from looktwice.model.formats.pieces import NOTHING, Choice, Format, Literal, Option, Section, Sequence, Values


def branching(*texts: str, times: int = 1) -> Format:
    choice = Choice(tuple(map(Option, texts)), name="way")
    return Format("made up", Section("way", Sequence((choice,) * times + (Literal("!"),))))


def test_the_branch_is_a_choice_of_the_format() -> None:
    way = Branch("way", direct="go", reflecting="stop")
    changed = replace(TRAJ_ONLY, format=branching("go", "stop", "wait"), trajectory="way")
    assert replace(changed, branch=way, reflection="way").branch == way
    with pytest.raises(FamilyError, match="a second look writes a reflection or a plan"):
        replace(changed, branch=way)


def test_a_reflection_of_several_values_is_told_in_words() -> None:
    two = Section("why", Sequence((Choice((Option("a"), Option("b"))), Choice((Option("c"), Option("d"))))))
    speaking = replace(TRAJ_ONLY, format=Format("made up", two), trajectory="why")
    with pytest.raises(FamilyError, match="section 'why' holds 2 values; say by reflection_text"):
        replace(speaking, reflection="why")
    told = replace(speaking, reflection="why", reflection_text=lambda values: " and ".join(map(str, values)))
    assert told.reflected(Values({"why": ("a", "d")})) == "a and d"
    assert told.reflected(NOTHING) is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"first_plan": "verse"}, "family 'traj_only': its format has no section 'verse'"),
        ({"trajectory": "verse"}, "has no section 'verse'"),
        ({"branch": CF_VLA.branch}, "its format has no section 'branch'"),
        ({"format": branching("go", "stop", times=2)}, "has 2 choices 'way', not one"),
        ({"format": branching("go", "halt")}, "choice 'way' has no option 'stop'"),
        # Controls decide with one token: those who plan and those who stop must differ in their first.
        ({"format": branching("go", "stop", "stopping")}, "the options of 'way' must begin differently"),
    ],
)
def test_a_family_fits_its_format(changes: dict[str, Any], message: str) -> None:
    if "format" in changes:
        way = Branch("way", direct="go", reflecting="stop")
        changes = {"trajectory": "way", "branch": way, "reflection": "way"} | changes
    with pytest.raises(FamilyError, match=message):
        replace(TRAJ_ONLY, **changes)
