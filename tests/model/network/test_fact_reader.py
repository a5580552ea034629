"""Facts as a network plans by them."""

import torch

from looktwice.model.driving.facts import FACT_GROUPS, FACTS, IS_YES_OR_NO
from looktwice.model.network.fact_reader import FactReader, likely, weighed

OWN, SPEED, ROAD = (FACTS.index(name) for name in ("own_0_present", "own_0_speed", "road_left_8m"))


def test_each_group_is_read_from_a_token_of_its_own() -> None:
    torch.manual_seed(0)
    reader, gathered = FactReader(8), torch.randn(1, len(FACT_GROUPS) + 4, 8)
    read, first = reader(gathered), 0
    assert read.shape == (1, len(FACTS))
    for place, fields in enumerate(FACT_GROUPS):
        other = gathered.clone()
        other[:, place] += 1
        changed = (reader(other) != read)[0].nonzero()[:, 0].tolist()
        assert changed == list(range(first, first + len(fields)))
        first += len(fields)


def test_logits_become_probabilities_and_values_stay() -> None:
    read = torch.full((1, len(FACTS)), 3.0)
    told = likely(read)[0]
    yes_or_no = torch.from_numpy(IS_YES_OR_NO)
    assert ((told[yes_or_no] > 0.95) & (told[yes_or_no] < 1)).all()
    assert (told[~yes_or_no] == 3.0).all()


def test_what_is_read_counts_as_much_as_it_is_there() -> None:
    facts = torch.rand(1, len(FACTS))
    facts[0, OWN] = 0.5
    told = weighed(facts)[0]
    assert told[SPEED] == facts[0, SPEED] / 2
    assert told[ROAD] == facts[0, ROAD]


def test_what_is_not_there_counts_nothing() -> None:
    facts = torch.full((1, len(FACTS)), float("nan"))
    facts[0, OWN] = 0.0
    assert (weighed(facts) == 0).all()
