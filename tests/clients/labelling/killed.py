"""A labelling run in a process of its own, to be killed. Imports nothing that starts threads."""

from __future__ import annotations

import asyncio
from pathlib import Path

from clients.labelling.label import config_of, jobs, labeller, questions
from clients.labelling.ledger import Ledger
from clients.labelling.pipeline import Limits, work_through
from clients.labelling.teachers.openai import OpenAiSettings, OpenAiTeacher

AT_ONCE = 4


def label_all(folder: Path, scenes: Path, url: str, key: str) -> None:
    """What `looktwice build label` does with an endpoint as its teacher."""

    async def run() -> None:
        teacher = OpenAiTeacher(OpenAiSettings(f"{url}/v1", "some-vlm", key))
        with Ledger(folder) as ledger:
            rollout = ledger.the_run("rollout")
            begun = ledger.run("label", config_of(rollout, teacher, 0))
            found = jobs(begun, questions(ledger, rollout, scenes))
            work = labeller(ledger, begun, teacher)
            try:
                await work_through(ledger, begun, found, work, Limits(AT_ONCE))
            finally:
                await teacher.close()

    asyncio.run(run())
