"""Which families there are: ours, and those that installed packages declare.

A package declares a family by an entry point whose name is the family's::

    [project.entry-points."looktwice.families"]
    my_family = "my_package.my_family:MY_FAMILY"
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Final

from looktwice.model.driving.phrases import ReflectionLanguage
from looktwice.model.families.cf_vla import CF_VLA
from looktwice.model.families.cf_vla.traj_only import TRAJ_ONLY
from looktwice.model.families.elf_vla import ELF_VLA, ELF_VLA_REFINE
from looktwice.model.families.family import Family, FamilyError
from looktwice.model.families.vla_world import VLA_WORLD

GROUP: Final = "looktwice.families"
"""The entry points that declare families."""

OURS: Final = {family.name: family for family in (CF_VLA, TRAJ_ONLY, ELF_VLA, ELF_VLA_REFINE, VLA_WORLD)}
"""The families of LookTwice itself, by name."""
FROM_SCRATCH: Final = (CF_VLA.name, TRAJ_ONLY.name)
"""The formats of a checkpoint that is trained from scratch, the default first."""


@cache
def family_named(name: str) -> Family:
    """The family of a name, as requests and checkpoints give it.

    Raises:
        FamilyError: nobody declares it, more than one package does, or it cannot be loaded.
    """
    found = list(entry_points(group=GROUP, name=name))
    if name in OURS and not found:
        return OURS[name]
    if not found:
        known = sorted({*OURS, *(each.name for each in entry_points(group=GROUP))})
        raise FamilyError(f"no model family {name!r}; known are {', '.join(known)}")
    if len(found) > 1 or name in OURS:
        raise FamilyError(f"model family {name!r} is declared more than once: {', '.join(map(str, found))}")
    return _loaded(found[0])


def families_of(names: Iterable[str], reflection: ReflectionLanguage) -> dict[str, Family]:
    """Families by name, in the dialect of a checkpoint whose reflections are so written."""
    return {name: family_named(name).in_dialect(reflection) for name in names}


def _loaded(entry: EntryPoint) -> Family:
    try:
        family = entry.load()
    except Exception as error:  # a user's module may raise anything
        raise FamilyError(f"model family {entry.name!r} ({entry.value}) cannot be loaded: {error}") from error
    if not isinstance(family, Family) or family.name != entry.name:
        raise FamilyError(f"entry point {entry.name!r} ({entry.value}) is no family of that name: {family!r}")
    return family
