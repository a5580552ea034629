"""A labelling run in a process of its own, to be killed. Imports nothing that starts threads."""

from __future__ import annotations

import asyncio
from pathlib import Path

from looktwice.clients.labelling.feedback_set import (
    FeedbackSample,
    Inference,
    feedback_config,
    feedback_jobs,
    infer,
    inference_config,
    sampled,
    writer,
)
from looktwice.clients.labelling.label import config_of, jobs, labeller, questions
from looktwice.clients.labelling.ledger import Ledger
from looktwice.clients.labelling.pipeline import StageLimits, work_through
from looktwice.clients.labelling.rollout import RETRY_POLICY
from looktwice.clients.labelling.rollout import jobs as rollout_jobs
from looktwice.clients.labelling.teachers.openai import OpenAiSettings, OpenAiTeacher
from looktwice.clients.planner import AsyncPlannerClient
from looktwice.clients.wire import ModelName

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
                await work_through(ledger, begun, found, work, StageLimits(AT_ONCE))
            finally:
                await teacher.close()

    asyncio.run(run())


def fail_all(folder: Path, scenes: Path, service: str, teacher_url: str, key: str) -> None:
    """What `looktwice failures` does with an endpoint as its teacher."""

    async def run() -> None:
        inference, sample = Inference(n=2), FeedbackSample(threshold=1.0)
        teacher = OpenAiTeacher(OpenAiSettings(f"{teacher_url}/v1", "some-vlm", key))
        with Ledger(folder) as ledger:
            async with AsyncPlannerClient(service, RETRY_POLICY) as planner:
                (card, *_) = await planner.models()
                model = ModelName(name=card.name, revision=card.revision)
                inferred = ledger.run("inference", inference_config(model, inference))
                await work_through(
                    ledger,
                    inferred,
                    rollout_jobs(inferred, scenes, lambda _: None),
                    lambda job: infer(planner, job.subject, model, inference),
                    StageLimits(AT_ONCE),
                )
            begun = ledger.run("feedback", feedback_config(inferred, teacher, sample.threshold))
            chosen = sampled(ledger, inferred, sample)
            try:
                await work_through(
                    ledger,
                    begun,
                    feedback_jobs(ledger, inferred, begun, chosen, scenes),
                    writer(ledger, begun, teacher, inference.version, sample.threshold),
                    StageLimits(AT_ONCE),
                )
            finally:
                await teacher.close()

    asyncio.run(run())
