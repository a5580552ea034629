"""A request that is ready to be sent: nothing but bytes, so that processes that send it load nothing else."""

from __future__ import annotations

from dataclasses import dataclass, field

from loadtests.mix import Kind


@dataclass(frozen=True)
class Call:
    """What goes over the wire.

    Attributes:
        kind: what it asks for.
        path: of the endpoint.
        headers: names and values, besides those of the target.
        body: written as the kind's payload says.
    """

    kind: Kind
    path: str
    headers: tuple[tuple[str, str], ...]
    body: bytes = field(repr=False)
