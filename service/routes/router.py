"""The endpoints."""

from __future__ import annotations

import time

from fastapi import APIRouter

from looktwice.service.admission.places import Admission
from looktwice.service.routes.chat import chat_router
from looktwice.service.routes.dependencies import Dependencies
from looktwice.service.routes.feedback import feedback_router
from looktwice.service.routes.imagine import imagine_router
from looktwice.service.routes.label import label_router
from looktwice.service.routes.models import models_router
from looktwice.service.routes.plan import plan_router
from looktwice.service.routes.probes import probes_router
from looktwice.service.routes.refine import refine_router
from looktwice.service.routes.scenes import scenes_router
from looktwice.service.routes.score import score_router


def make_router(deps: Dependencies) -> APIRouter:
    """All endpoints but the inspector page."""
    router = APIRouter()
    router.include_router(plan_router(deps))
    router.include_router(refine_router(deps))
    router.include_router(imagine_router(deps))
    router.include_router(chat_router(deps))
    router.include_router(label_router(deps))
    scoring = Admission(deps.settings.max_scenes, deps.settings.max_scenes, time.monotonic)
    router.include_router(score_router(deps, scoring))
    router.include_router(feedback_router(deps, scoring))
    router.include_router(models_router(deps))
    router.include_router(probes_router(deps))
    router.include_router(scenes_router(deps))
    return router
