"""Reflections in phrases from a vision-language teacher: it fills in fields, and the words are ours.

What it may answer is a JSON schema, which most endpoints can be held to; its facts become a reflection in
phrases (`looktwice.model.driving.phrases`), so that checks read fields and no English.
"""

from __future__ import annotations

from typing import Annotated, Any, Final

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from looktwice.model.driving.phrases import (
    FARTHEST_M,
    HEADS,
    STEP_M,
    Bend,
    Consequence,
    Correction,
    Cue,
    Facts,
    PhraseError,
    Spot,
    Statement,
    Thing,
    consequences,
)

Seen = Annotated[str, Field(json_schema_extra={"enum": list(HEADS)})]


class _Answer(BaseModel):
    # Strict: an endpoint that is held to the schema writes every field.
    model_config = ConfigDict(frozen=True, extra="forbid")


class ToldStatement(_Answer):
    """One statement as a teacher fills it in."""

    seen: Seen
    place: Spot | None
    ahead_m: int | None
    consequence: Consequence
    correction: Correction


class ToldFacts(_Answer):
    """A teacher's answer."""

    statements: list[ToldStatement]


RESPONSE_FORMAT: Final[dict[str, Any]] = {
    "type": "json_schema",
    "json_schema": {"name": "reflection", "strict": True, "schema": ToldFacts.model_json_schema()},
}
"""Of POST /chat/completions."""

TABLE: Final = "\n".join(
    f"- {text}: " + "; ".join(f"{bad} → {', '.join(good)}" for bad, good in consequences(head).items())
    for text, head in HEADS.items()
)
"""What may be seen, what it may lead to, and which corrections that asks for: a line each."""


def phrases_of(answer: str) -> str:
    """The reflection in phrases that a teacher's JSON stands for.

    Raises:
        PhraseError: it is no such JSON, or its facts do not go together; the text tells its writer why.
    """
    try:
        told = ToldFacts.model_validate_json(answer)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise PhraseError(
            f"answer with the JSON that was asked for: {place or 'JSON'}: {first['msg']}"
        ) from None
    return str(Facts(tuple(map(_statement, told.statements))))


def _statement(told: ToldStatement) -> Statement:
    return Statement(_cue(told), told.consequence, told.correction)


def _cue(told: ToldStatement) -> Cue:
    head = HEADS.get(told.seen)
    metres = None if told.ahead_m is None else STEP_M * round(told.ahead_m / STEP_M)
    if metres is not None and not 0 <= metres <= FARTHEST_M:
        raise PhraseError(f"ahead_m is from 0 to {FARTHEST_M}, not {told.ahead_m}")
    match head:
        case None:
            raise PhraseError(f"{told.seen!r} is none of {', '.join(HEADS)}")
        case (kind, state):
            if told.place is None or metres is None:
                raise PhraseError(f"{told.seen!r} needs a place and ahead_m")
            return Thing(kind, told.place, metres, state)
        case Bend(side):
            # "Right ahead" is no place of a bend.
            return Bend(side, metres or None)
        case _:
            return head
