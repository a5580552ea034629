from __future__ import annotations

import pytest

from looktwice.clients.labelling.leaks import find_leaks

LEAKS = [
    "The expert slows down here.",
    "Experts would brake earlier.",
    "The ground truth plan brakes.",
    "The ground-truth plan brakes.",
    "The groundtruth says so.",
    "GT meta-actions brake at two seconds.",
    "The label asks for braking.",
    "As labelled, the car should brake.",
    "According to the annotations, a van stands there.",
    "The dataset holds a braking car.",
    "In this data set cars brake.",
    "The reference driver brakes.",
    "The correct answer is to brake.",
    "The optimal plan brakes first.",
    "The recorded trajectory bends left.",
    "The trajectory suggests slowing down.",
    "The trajectories indicate slowing down.",
    "According to the images, a van is ahead.",
    "Based on the front video a van is ahead.",
    "The frames show a van.",
    "In the wide image a van is close.",
    "The van will brake at the junction.",
    "The vehicle is going to turn.",
    "The pedestrian is about to cross.",
    "The car seems likely to stop.",
    "The leader later brakes.",
    "Three seconds later the gap closes.",
    "In hindsight this was too fast.",
    "It turns out to be too fast.",
    "As an AI I would brake.",
    "The predicted actions are too fast.",
    "This prediction is wrong.",
    "I was given a plan that brakes.",
    "The human driver slows down.",
    "What actually happened is a stop.",
    "The EX\u00adPERT brakes.",
    "The e\u200bxpert brakes.",
    "The \uff27\uff34 brakes.",
    "The bounding boxes overlap.",
    "My instructions say to brake.",
    "The vehicle ahead will brake.",
    "The cyclist on the right will cross.",
    "The light will turn red.",
    "The bus at the stop is going to pull out.",
    "The gap soon will close.",
    "It'll stop behind the crossing.",
    "The better plan brakes first.",
    "The hint says to brake.",
    "Compared with the given trajectory this is fast.",
]
CLEAN = [
    "The van ahead in my lane is close and its brake lights are on. Accelerating from 2.1s would close the "
    "gap, so I should ease off now and keep a safe distance.",
    "The road bends left ahead. Going straight on would leave the lane, so I should turn left earlier.",
    "The lane is clear up to the horizon. Slowing down for so long is needlessly cautious; hold "
    "the speed instead.",
    "Cones close the right lane ahead, so moving to the left lane soon is the better way.",
    "A pedestrian stands at the kerb on the right. I should brake gently and be ready to stop.",
    "Both lanes look free, a steady speed fits the traffic around me.",
    "A van stands in my lane. I will brake, and then I'll move to the left lane.",
]


@pytest.mark.parametrize("text", LEAKS)
def test_what_gives_knowledge_away_is_found(text: str) -> None:
    assert find_leaks(text), text


@pytest.mark.parametrize("text", CLEAN)
def test_what_a_driver_may_say_is_not(text: str) -> None:
    assert find_leaks(text) == []
