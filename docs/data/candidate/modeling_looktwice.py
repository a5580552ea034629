"""The network of this checkpoint, from the package `looktwice`, which has to be installed."""

from looktwice.model.network.vla import LookTwiceVla as _LookTwiceVla


class LookTwiceVla(_LookTwiceVla):
    """As the package has it."""
