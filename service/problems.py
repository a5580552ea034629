"""The kinds of problems the service answers with: one table, whose types are part of the contract."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from looktwice.clients.wire import Fault

TYPE_BASE: Final = "https://looktwice.dev/problems/"


@dataclass(frozen=True)
class ProblemKind:
    """A kind of problem; ``slug`` is the last part of its stable type URI."""

    slug: str
    status: int
    title: str

    @property
    def type(self) -> str:
        """The type URI."""
        return TYPE_BASE + self.slug


INVALID_JSON: Final = ProblemKind("invalid-json", 400, "The body is not JSON")
INVALID_BODY: Final = ProblemKind("invalid-body", 400, "The body cannot be read")
UNAUTHORIZED: Final = ProblemKind("unauthorized", 401, "This needs a key")
NOT_FOUND: Final = ProblemKind("not-found", 404, "There is nothing here")
FORBIDDEN: Final = ProblemKind("forbidden", 403, "This key does not open this")
UNKNOWN_MODEL: Final = ProblemKind("unknown-model", 404, "There is no such model here")
UNKNOWN_CHECKPOINT: Final = ProblemKind("unknown-checkpoint", 404, "There is no such checkpoint")
UNKNOWN_SCENE: Final = ProblemKind("unknown-scene", 404, "There is no such scene")
METHOD_NOT_ALLOWED: Final = ProblemKind("method-not-allowed", 405, "This method is not allowed here")
BODY_TIMEOUT: Final = ProblemKind("body-timeout", 408, "The body came too slowly")
SWAP_UNDER_WAY: Final = ProblemKind("swap-under-way", 409, "Another checkpoint is being loaded")
MISDIRECTED: Final = ProblemKind("misdirected", 421, "This service does not answer to that name")
BODY_TOO_LARGE: Final = ProblemKind("body-too-large", 413, "The body is too large")
UNSUPPORTED_MEDIA_TYPE: Final = ProblemKind(
    "unsupported-media-type", 415, "The body is of a type not taken here"
)
INVALID_REQUEST: Final = ProblemKind("invalid-request", 422, "The request breaks the contract")
UNKNOWN_FIELD: Final = ProblemKind("unknown-field", 422, "The request holds a field that does not exist")
INVALID_CLIP: Final = ProblemKind("invalid-clip", 422, "A camera clip is not four frames of one camera")
UNKNOWN_CAMERA: Final = ProblemKind("unknown-camera", 422, "There is no such camera")
MISSING_CAMERA: Final = ProblemKind("missing-camera", 422, "The model needs a camera that the scene lacks")
INVALID_IMAGE: Final = ProblemKind("invalid-image", 422, "A picture cannot be accepted")
INVALID_HISTORY: Final = ProblemKind(
    "invalid-history", 422, "The ego history is not one a car can have driven"
)
INVALID_ROUTE: Final = ProblemKind("invalid-route", 422, "The route is not 20 points in the ego frame")
INVALID_TRACKS: Final = ProblemKind("invalid-tracks", 422, "The tracks are not ones that the model can take")
INVALID_CONTROLS: Final = ProblemKind(
    "invalid-controls", 422, "The controls contradict each other or their limits"
)
INVALID_PLAN: Final = ProblemKind("invalid-plan", 422, "The given plan breaks the plan language")
INVALID_LABELS: Final = ProblemKind("invalid-labels", 422, "The labels are not ones to score by")
INVALID_TRAJECTORY: Final = ProblemKind("invalid-trajectory", 422, "A trajectory cannot be taken")
INVALID_ATTEMPT: Final = ProblemKind("invalid-attempt", 422, "The attempt is not one that the format refines")
INVALID_FEEDBACK: Final = ProblemKind(
    "invalid-feedback", 422, "The feedback is not of the form, or tells no facts"
)
CANNOT_IMAGINE: Final = ProblemKind("cannot-imagine", 422, "The model imagines no such pictures")
OTHER_PLAN: Final = ProblemKind("other-plan", 422, "The feedback is for another plan")
UNKNOWN_FORMAT: Final = ProblemKind("unknown-format", 422, "The model does not write this response format")
REFUSED: Final = ProblemKind("request-refused", 422, "The model cannot serve this request")
INVALID_SCENE_FILE: Final = ProblemKind("invalid-scene-file", 422, "This is not a scene file of this version")
IDEMPOTENCY_KEY_REUSED: Final = ProblemKind(
    "idempotency-key-reused", 422, "The idempotency key came with another request before"
)
QUEUE_FULL: Final = ProblemKind("queue-full", 429, "The service has as much to do as it accepts")
RATE_LIMITED: Final = ProblemKind("rate-limited", 429, "The caller has asked for as much as is allowed")
INTERNAL: Final = ProblemKind("internal", 500, "The service failed")
NEEDS_ANNOTATIONS: Final = ProblemKind("needs-annotations", 422, "The teacher needs what the request lacks")
NEEDS_TRACKS: Final = ProblemKind(
    "needs-tracks", 422, "Feedback is made of tracked objects, and none are sent"
)
NOTHING_IN_VIEW: Final = ProblemKind(
    "nothing-in-view", 422, "The teacher sees nothing that asks for the better plan"
)
TEACHER_REFUSED: Final = ProblemKind("teacher-refused", 502, "The teacher does not take the question")
LABEL_REFUSED: Final = ProblemKind("label-refused", 502, "None of the teacher's answers passed the checks")
FEEDBACK_REFUSED: Final = ProblemKind(
    "feedback-refused", 502, "None of the teacher's feedback passed the checks"
)
TEACHER_AWAY: Final = ProblemKind("teacher-away", 503, "The teacher does not answer")
SCENES_UNREADABLE: Final = ProblemKind("scenes-unreadable", 500, "The bundled scenes cannot be read")
NOT_READY: Final = ProblemKind("not-ready", 503, "The model is not ready")
DRAINING: Final = ProblemKind("draining", 503, "The service is about to stop")
ENGINE_FAILED: Final = ProblemKind("engine-failed", 503, "The engine failed")
QUEUE_TIMEOUT: Final = ProblemKind("queue-timeout", 503, "The request waited too long for its turn")
DECODE_TIMEOUT: Final = ProblemKind("decode-timeout", 504, "Decoding took too long")
CHECKPOINT_FAILED: Final = ProblemKind("checkpoint-failed", 422, "The checkpoint cannot be served")

KINDS: Final = tuple(value for value in list(globals().values()) if isinstance(value, ProblemKind))
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
        self, kind: ProblemKind, detail: str, errors: Sequence[Fault] = (), retry_after_s: int | None = None
    ) -> None:
        super().__init__(detail)
        self.kind, self.detail, self.errors = kind, detail, tuple(errors)
        waits = retry_after_s is None and kind.status == 503
        self.retry_after_s = RETRY_AFTER_S if waits else retry_after_s


def unforeseen() -> ProblemError:
    """What a caller is told of a defect: nothing but where it is written down."""
    return ProblemError(INTERNAL, "an unforeseen error; the service's log has it by request id")


def at(
    kind: ProblemKind, pointer: str, detail: str, line: int | None = None, column: int | None = None
) -> ProblemError:
    """A problem with one known place in the body; ``line`` and ``column`` are those of a text there."""
    fault = Fault(pointer=pointer, detail=detail, line=line, column=column)
    return ProblemError(kind, f"{pointer}: {detail}", [fault])
