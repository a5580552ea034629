"""What can be wrong with an egodriver call; `looktwice.clients.alpasim.servicer` gives each kind its gRPC
status."""

from __future__ import annotations


class EgodriverError(Exception):
    """Base of everything that ends a call; the text says what is wrong and what to change."""


class UnknownSession(EgodriverError):
    """No such session is open."""


class SessionExists(EgodriverError):
    """A session of this name is open already."""


class TooManySessions(EgodriverError):
    """No room for another session now."""


class Draining(EgodriverError):
    """The driver is going away and takes no new sessions."""


class BadObservation(EgodriverError):
    """An observation that cannot be read."""


class BadSession(EgodriverError):
    """The session cannot be driven: a camera that the model needs is not declared."""


class BadHistory(EgodriverError):
    """Poses or pictures are too old, or have a gap: no plan could be trusted."""


class TooEarly(EgodriverError):
    """Not enough was seen yet; time will help. The contract answers with an empty trajectory."""
