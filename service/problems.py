"""The kinds of problems the service answers with: one table, whose types are part of the contract."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from looktwice.clients.wire import Fault

TYPE_BASE: Final = "https://looktwice.dev/problems/"


@dataclass(frozen=True)
class Kind:
    """A kind of problem; ``slug`` is the last part of its stable type URI."""

    slug: str
    status: int
    title: str

    @property
    def type(self) -> str:
        """The type URI."""
        return TYPE_BASE + self.slug


INVALID_JSON: Final = Kind("invalid-json", 400, "The body is not JSON")
INVALID_BODY: Final = Kind("invalid-body", 400, "The body cannot be read")
UNAUTHORIZED: Final = Kind("unauthorized", 401, "This needs a key")
NOT_FOUND: Final = Kind("not-found", 404, "There is nothing here")
FORBIDDEN: Final = Kind("forbidden", 403, "This key does not open this")
UNKNOWN_MODEL: Final = Kind("unknown-model", 404, "There is no such model here")
UNKNOWN_CHECKPOINT: Final = Kind("unknown-checkpoint", 404, "There is no such checkpoint")
UNKNOWN_SCENE: Final = Kind("unknown-scene", 404, "There is no such scene")
METHOD_NOT_ALLOWED: Final = Kind("method-not-allowed", 405, "This method is not allowed here")
BODY_TIMEOUT: Final = Kind("body-timeout", 408, "The body came too slowly")
SWAP_UNDER_WAY: Final = Kind("swap-under-way", 409, "Another checkpoint is being loaded")
MISDIRECTED: Final = Kind("misdirected", 421, "This service does not answer to that name")
BODY_TOO_LARGE: Final = Kind("body-too-large", 413, "The body is too large")
UNSUPPORTED_MEDIA_TYPE: Final = Kind("unsupported-media-type", 415, "The body is of a type not taken here")
INVALID_REQUEST: Final = Kind("invalid-request", 422, "The request breaks the contract")
UNKNOWN_FIELD: Final = Kind("unknown-field", 422, "The request holds a field that does not exist")
INVALID_CLIP: Final = Kind("invalid-clip", 422, "A camera clip is not four frames of one camera")
UNKNOWN_CAMERA: Final = Kind("unknown-camera", 422, "There is no such camera")
MISSING_CAMERA: Final = Kind("missing-camera", 422, "The model needs a camera that the scene lacks")
INVALID_IMAGE: Final = Kind("invalid-image", 422, "A picture cannot be accepted")
INVALID_HISTORY: Final = Kind("invalid-history", 422, "The ego history is not one a car can have driven")
INVALID_ROUTE: Final = Kind("invalid-route", 422, "The route is not 20 points in the ego frame")
INVALID_TRACKS: Final = Kind("invalid-tracks", 422, "The tracks are not ones that the model can take")
INVALID_CONTROLS: Final = Kind("invalid-controls", 422, "The controls contradict each other or their limits")
INVALID_PLAN: Final = Kind("invalid-plan", 422, "The given plan breaks the plan language")
INVALID_LABELS: Final = Kind("invalid-labels", 422, "The labels are not ones to score by")
INVALID_TRAJECTORY: Final = Kind("invalid-trajectory", 422, "A trajectory cannot be taken")
INVALID_ATTEMPT: Final = Kind("invalid-attempt", 422, "The attempt is not one that the format refines")
INVALID_FEEDBACK: Final = Kind("invalid-feedback", 422, "The feedback is not of the form, or tells no facts")
CANNOT_IMAGINE: Final = Kind("cannot-imagine", 422, "The model imagines no such pictures")
OTHER_PLAN: Final = Kind("other-plan", 422, "The feedback is for another plan")
UNKNOWN_FORMAT: Final = Kind("unknown-format", 422, "The model does not write this response format")
REFUSED: Final = Kind("request-refused", 422, "The model cannot serve this request")
INVALID_SCENE_FILE: Final = Kind("invalid-scene-file", 422, "This is not a scene file of this version")
IDEMPOTENCY_KEY_REUSED: Final = Kind(
    "idempotency-key-reused", 422, "The idempotency key came with another request before"
)
QUEUE_FULL: Final = Kind("queue-full", 429, "The service has as much to do as it accepts")
RATE_LIMITED: Final = Kind("rate-limited", 429, "The caller has asked for as much as is allowed")
INTERNAL: Final = Kind("internal", 500, "The service failed")
NEEDS_ANNOTATIONS: Final = Kind("needs-annotations", 422, "The teacher needs what the request lacks")
NEEDS_TRACKS: Final = Kind("needs-tracks", 422, "Feedback is made of tracked objects, and none are sent")
NOTHING_IN_VIEW: Final = Kind(
    "nothing-in-view", 422, "The teacher sees nothing that asks for the better plan"
)
TEACHER_REFUSED: Final = Kind("teacher-refused", 502, "The teacher does not take the question")
LABEL_REFUSED: Final = Kind("label-refused", 502, "None of the teacher's answers passed the checks")
FEEDBACK_REFUSED: Final = Kind("feedback-refused", 502, "None of the teacher's feedback passed the checks")
TEACHER_AWAY: Final = Kind("teacher-away", 503, "The teacher does not answer")
SCENES_UNREADABLE: Final = Kind("scenes-unreadable", 500, "The bundled scenes cannot be read")
NOT_READY: Final = Kind("not-ready", 503, "The model is not ready")
DRAINING: Final = Kind("draining", 503, "The service is about to stop")
ENGINE_FAILED: Final = Kind("engine-failed", 503, "The engine failed")
QUEUE_TIMEOUT: Final = Kind("queue-timeout", 503, "The request waited too long for its turn")
DECODE_TIMEOUT: Final = Kind("decode-timeout", 504, "Decoding took too long")
CHECKPOINT_FAILED: Final = Kind("checkpoint-failed", 422, "The checkpoint cannot be served")

KINDS: Final = tuple(value for value in list(globals().values()) if isinstance(value, Kind))
"""All of them, in the table's order."""

RETRY_AFTER_S: Final = 1
"""Where nothing better is known."""
REJECTIONS: Final = frozenset(
    (
        *(UNAUTHORIZED, MISDIRECTED, BODY_TIMEOUT, BODY_TOO_LARGE, QUEUE_FULL, RATE_LIMITED),
        *(NOT_READY, DRAINING, ENGINE_FAILED, QUEUE_TIMEOUT, DECODE_TIMEOUT),
    )
)
"""Requests that may have been right and were not served."""
NOT_NOW: Final = (NOT_READY, DRAINING, ENGINE_FAILED)
"""While no engine can answer."""


class ProblemError(Exception):
    """Ends a request with a problem document.

    Attributes:
        kind: which problem.
        detail: what is wrong here, and what to change.
        errors: the places in the body that are wrong.
        retry_after_s: whole seconds after which the same request may succeed; None where it never will.
    """

    def __init__(
        self, kind: Kind, detail: str, errors: Sequence[Fault] = (), retry_after_s: int | None = None
    ) -> None:
        super().__init__(detail)
        self.kind, self.detail, self.errors = kind, detail, tuple(errors)
        waits = retry_after_s is None and kind.status == 503
        self.retry_after_s = RETRY_AFTER_S if waits else retry_after_s


def unforeseen() -> ProblemError:
    """What a caller is told of a defect: nothing but where it is written down."""
    return ProblemError(INTERNAL, "an unforeseen error; the service's log has it by request id")


def at(
    kind: Kind, pointer: str, detail: str, line: int | None = None, column: int | None = None
) -> ProblemError:
    """A problem with one known place in the body; ``line`` and ``column`` are those of a text there."""
    fault = Fault(pointer=pointer, detail=detail, line=line, column=column)
    return ProblemError(kind, f"{pointer}: {detail}", [fault])
