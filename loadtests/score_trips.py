"""What scores of one scene take over HTTP, one request after the other."""

from __future__ import annotations

import statistics
import time
from typing import Final

import httpx

from looktwice.clients.wire_scores import EgoMotion, Labels, PastMotion, ScoredAgent, ScoredLane, ScoreRequest
from looktwice.loadtests.overhead import NoAnswer
from looktwice.model.driving.pdm.world import ACCELERATION, HEADING, SPEED, Area, Array, World

_WARM_UP: Final = 3


def score_request(world: World, plans: Array) -> ScoreRequest:
    """The body of POST /v1/score for plans [n, 8 or 64, 3], the first of which is the reference too.

    The world knows all layers, and holds vehicles and no red lights. Its ego and its past go straight on.
    """
    return ScoreRequest(
        labels=Labels(
            ego=EgoMotion(speed_mps=world.ego[SPEED]),
            past=[
                PastMotion(heading_rad=row[HEADING], acceleration_mps2=row[ACCELERATION])
                for row in (() if world.past is None else world.past)
            ],
            agents=[
                ScoredAgent(
                    agent_id=track.track_id,
                    kind="vehicle",
                    length_m=track.length_m,
                    width_m=track.width_m,
                    poses=track.poses.tolist(),
                    speed_mps=track.first_speed_mps,
                )
                for track in world.tracks or ()
            ],
            lanes=[
                ScoredLane(lane_id=lane.lane_id, ring=_rings(lane.area)[0], on_route=lane.on_route)
                for lane in world.lanes or ()
            ],
            intersections=[_rings(area)[0] for area in world.intersections or ()],
            drivable=[_rings(area) for area in world.drivable or ()],
            red_lights=[],
            centreline=None if world.centreline is None else world.centreline.tolist(),
        ),
        trajectories=plans.tolist(),
        reference=plans[0].tolist(),
    )


def score_ms(http: httpx.Client, asked: ScoreRequest, requests: int) -> float:
    """The median time until an answer is read, a few requests for warming up apart.

    Raises:
        NoAnswer: an answer has no scores.
        httpx.HTTPError: the service is not there.
    """
    content, headers = asked.model_dump_json().encode(), {"Content-Type": "application/json"}
    spent = list[float]()
    for _ in range(_WARM_UP + requests):
        began_s = time.perf_counter()
        answer = http.post("/v1/score", content=content, headers=headers)
        spent.append(1000 * (time.perf_counter() - began_s))
        if answer.status_code != 200:
            raise NoAnswer(f"the service answered {answer.status_code}: {answer.text[:300]}")
    return statistics.median(spent[_WARM_UP:])


def _rings(area: Area) -> list[list[list[float]]]:
    return [ring.tolist() for ring in area.rings]
