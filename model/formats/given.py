"""Formats in which some sections are given by the caller."""

from __future__ import annotations

from model.driving.plan import Plan, format_tick, plan_from_bins
from model.formats.pieces import (
    Choice,
    FormatError,
    Literal,
    Option,
    Piece,
    PlanTracks,
    Section,
    Sequence,
    Track,
    TrackWord,
    Values,
)


def with_given(piece: Piece, given: Values, section: str | None = None) -> Piece:
    """``piece`` with the plans of given sections written out as literals, piece by piece.

    So a given plan is tokenised exactly as if the model had written it; equal neighbours are joined first,
    as no model writes them.

    Raises:
        FormatError: a given value is no plan, or has more meta-actions than the format allows.
    """
    match piece:
        case Section(name, body):
            return Section(name, with_given(body, given, name))
        case Sequence(parts):
            return Sequence(tuple(with_given(part, given, section) for part in parts))
        case Choice(options, name):
            return Choice(
                tuple(Option(option.text, with_given(option.then, given, section)) for option in options),
                name,
            )
        case PlanTracks() if section is not None and section in given:
            plan = given[section]
            if not isinstance(plan, Plan):
                raise FormatError(f"section {section!r} needs a plan")
            return _written_plan(plan, section)
        case _:
            return piece


def _written_plan(plan: Plan, section: str) -> Sequence:
    """The pieces that a plan's text is made of, each as a literal: tokenised as decoding would."""
    parts: list[Piece] = []
    for group, track in plan_from_bins(plan.bins()).tracks():
        rest: Piece = PlanTracks((group,))
        answers = iter([text for action in track for text in (format_tick(action.end), f" {action.word}")])
        stack: list[Piece] = [rest]
        while stack:
            piece = stack.pop()
            match piece:
                case Literal():
                    parts.append(piece)
                case Sequence(pieces):
                    stack += reversed(pieces)
                case PlanTracks() | Track() | TrackWord():
                    stack.append(piece.expand())
                case Choice(options):
                    text = next(answers)
                    chosen = [option for option in options if option.text == text]
                    if not chosen:
                        raise FormatError(
                            f"section {section!r}: track {group} has more meta-actions than the format allows"
                        )
                    parts.append(Literal(text))
                    stack.append(chosen[0].then)
                case _:
                    raise FormatError(f"a plan holds no {type(piece).__name__}")
    return Sequence(tuple(parts))
