"""The processor of this checkpoint, from the package `looktwice`, which has to be installed."""

from looktwice.model.network.processor import LookTwiceProcessor as _LookTwiceProcessor


class LookTwiceProcessor(_LookTwiceProcessor):
    """As the package has it."""
