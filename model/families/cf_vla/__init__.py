"""CF-VLA: plans, and looks a second time before it acts where the plan may be wrong."""

from typing import Final

from looktwice.model.families.cf_vla import format as its
from looktwice.model.families.cf_vla.corpus import CORPUS
from looktwice.model.families.cf_vla.read import read
from looktwice.model.families.cf_vla.targets import teach
from looktwice.model.families.family import Branch, Family

CF_VLA: Final = Family(
    format=its.FREE_TEXT,
    dialects={"phrases": its.PHRASES},
    task="Propose meta-actions; only if they are wrong, reflect and correct them. Then give the trajectory.",
    first_plan=its.PLAN,
    branch=Branch(its.BRANCH, direct=its.ACTION, reflecting=its.THINKING),
    reflection=its.REFLECTION,
    revised_plan=its.REVISED_PLAN,
    teach=teach,
    trajectory=its.TRAJECTORY,
    read=read,
    title="meta-act",
    about="writes a driving plan in words, may look at it twice, and gives 6.4 s of trajectory",
    corpus=CORPUS,
)
"""plan, branch { act: trajectory | reflect: reflection, revised plan, trajectory }"""
