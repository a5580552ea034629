"""What talks to a service over HTTP: the planner client, builds of data sets, the simulator."""

if __name__ != "looktwice.clients":
    raise ImportError(f"{__name__} is looktwice.clients; import it by that name")

from looktwice.clients.planner import PlannerClient

__all__ = ["PlannerClient"]
