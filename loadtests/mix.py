"""What is asked: kinds of requests, and how often each occurs in a mix."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, TypeVar, cast, get_args

import numpy as np

Work = Literal["plan", "direct", "think", "reflect", "label", "batch", "imagine"]
Payload = Literal["json", "msgpack", "multipart"]
_Choice = TypeVar("_Choice")

BATCH_SCENES: Final = 4
"""Of one request to /v1/plan/batch."""
_STREAMED: Final = ("plan", "direct", "think", "reflect", "imagine")
_UNHURRIED: Final = ("label", "imagine")
"""What takes no deadline."""


@dataclass(frozen=True)
class RequestKind:
    """What tells one request from another as far as load goes.

    Attributes:
        work: ``plan`` lets the model decide whether to think, ``direct`` and ``think`` decide for it;
            ``reflect``, ``label`` and ``imagine`` are the endpoints of these names, ``batch`` plans for
            several scenes.
        n: draws of each scene; of ``imagine``, pictures.
        payload: how the body is written.
        stream: whether the answer comes as events.
        deadline_ms: told to the service; None for none.
    """

    work: Work = "plan"
    n: int = 6
    payload: Payload = "json"
    stream: bool = False
    deadline_ms: int | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.n <= 64:
            raise ValueError(f"{self.n} draws: there may be 1 to 64")
        if self.deadline_ms is not None and self.deadline_ms < 1:
            raise ValueError(f"a deadline of {self.deadline_ms} ms cannot be met")
        if self.deadline_ms is not None and self.work in _UNHURRIED:
            raise ValueError(f"{self.work} has no deadline")
        if self.stream and self.work not in _STREAMED:
            raise ValueError(f"{self.work} has no stream")

    def __str__(self) -> str:
        parts: list[str] = [self.work]
        if self.work != "label":
            parts.append(f"n={self.n}")
        parts.append(self.payload)
        if self.stream:
            parts.append("stream")
        if self.deadline_ms is not None:
            parts.append(f"within {self.deadline_ms} ms")
        return " ".join(parts)


@dataclass(frozen=True)
class Mix:
    """Weights of independent choices; only their proportions count.

    Attributes:
        works, draws, payloads, deadlines_ms: see `RequestKind`.
        stream: share of the requests that can be streamed and are.
    """

    works: Mapping[Work, float] = field(default_factory=lambda: {"plan": 1.0})
    draws: Mapping[int, float] = field(default_factory=lambda: {6: 1.0})
    payloads: Mapping[Payload, float] = field(default_factory=lambda: {"json": 1.0})
    deadlines_ms: Mapping[int | None, float] = field(default_factory=lambda: {None: 1.0})
    stream: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.stream <= 1:
            raise ValueError(f"the streamed share is from 0 to 1, not {self.stream}")

    def kinds(self, count: int, seed: int) -> list[RequestKind]:
        """So many kinds at random, the same for the same seed."""
        random = np.random.default_rng(seed)
        works = _chosen(self.works, count, random)
        draws = _chosen(self.draws, count, random)
        payloads = _chosen(self.payloads, count, random)
        deadlines_ms = _chosen(self.deadlines_ms, count, random)
        streams = random.random(count) < self.stream
        return [
            RequestKind("label", 1, payload)
            if work == "label"
            else RequestKind(
                work,
                n,
                payload,
                bool(stream) and work in _STREAMED,
                None if work in _UNHURRIED else deadline_ms,
            )
            for work, n, payload, deadline_ms, stream in zip(
                works, draws, payloads, deadlines_ms, streams, strict=True
            )
        ]


def parse_mix(works: str, draws: str, payloads: str, deadlines_ms: str, stream: float) -> Mix:
    """A mix from what is typed, such as ``direct=3,think=1``; raises `ValueError`."""
    return Mix(
        parse_weights(works, lambda name: cast(Work, _one_of(name, get_args(Work)))),
        parse_weights(draws, int),
        parse_weights(payloads, lambda name: cast(Payload, _one_of(name, get_args(Payload)))),
        parse_weights(deadlines_ms, lambda text: None if text == "none" else int(text)),
        stream,
    )


def parse_weights(text: str, read: Callable[[str], _Choice]) -> dict[_Choice, float]:
    """Weights by choice from ``A=3,B=1``, where ``A`` alone weighs 1.

    Raises:
        ValueError: a choice that ``read`` refuses, one that occurs twice, or weights without a sum.
    """
    weights: dict[_Choice, float] = {}
    for part in text.split(","):
        name, _, weight = part.strip().partition("=")
        choice = read(name)
        if choice in weights:
            raise ValueError(f"{name} occurs twice in {text!r}")
        weights[choice] = float(weight or 1)
    if not all(0 <= weight < float("inf") for weight in weights.values()) or not sum(weights.values()):
        raise ValueError(f"weights are not negative, and one is above 0: {text!r}")
    return weights


def _one_of(name: str, known: tuple[str, ...]) -> str:
    if name not in known:
        raise ValueError(f"{name!r} is none of {', '.join(known)}")
    return name


def _chosen(weights: Mapping[_Choice, float], count: int, random: np.random.Generator) -> list[_Choice]:
    choices, parts = list(weights), np.array(list(weights.values()))
    return [choices[place] for place in random.choice(len(choices), count, p=parts / parts.sum())]
