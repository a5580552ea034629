"""What makes decoding fast and changes no response, by name."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True)
class Shortcuts:
    """What makes decoding fast and changes no response. All can be switched off, to be compared with.

    Attributes:
        jump: a forced run goes through the network in one pass with the token before it.
        shared_rows: draws that have written the same tokens are one row.
        shared_prompts: a scene's prompt is worked out and held once for all its draws.
        speculate: a revised plan is fed as far as it may repeat the first one, and any response as the last
            one to the same pictures, or others, went on, as far as that is likely; a picture that is imagined
            as its camera sees it now, moved as the ego; what is fed ahead is checked.
        reuse: what pictures come to, and what all prompts begin with, is kept for those that come again (by
            the `Runner`).
        capture: on a GPU a pass is replayed as a whole where one of its sizes came before (by the `Runner`).
    """

    jump: bool = True
    shared_rows: bool = True
    shared_prompts: bool = True
    speculate: bool = True
    reuse: bool = True
    capture: bool = True

    @classmethod
    def none(cls) -> Shortcuts:
        """All switched off."""
        return cls(**{option.name: False for option in fields(cls)})
