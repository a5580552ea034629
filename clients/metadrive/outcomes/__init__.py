"""What comes of plans, in the worlds of generated scenes. A door: others import from here."""

from looktwice.clients.metadrive.generation.redrive import DescribedPilot
from looktwice.clients.metadrive.outcomes.replayed_worlds import (
    EpisodeSetting,
    FollowTask,
    Moment,
    ReplayError,
    redriver,
    setting_of,
)
from looktwice.clients.metadrive.outcomes.store import follow_unknown, outcome_store
from looktwice.clients.metadrive.outcomes.verdicts import MomentOutcomes
from looktwice.clients.metadrive.outcomes.workers import WorkerDied, follow_episodes
from looktwice.clients.metadrive.result_store import ResultStore
from looktwice.clients.metadrive.world.fork import Forked, fork_along, fork_expert

__all__ = [
    "DescribedPilot",
    "EpisodeSetting",
    "FollowTask",
    "Forked",
    "Moment",
    "MomentOutcomes",
    "ReplayError",
    "ResultStore",
    "WorkerDied",
    "follow_episodes",
    "follow_unknown",
    "fork_along",
    "fork_expert",
    "outcome_store",
    "redriver",
    "setting_of",
]
