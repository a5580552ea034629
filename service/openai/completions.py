"""Plans as chat completions; what the dialect has no words for is in a field ``looktwice``."""

from __future__ import annotations

import json
import time
from typing import Any, Final

import looktwice.clients.wire as wire
from looktwice.service.openai.chat_requests import ChatRequest
from looktwice.service.planning.events import PlannedScene
from looktwice.service.planning.section_text import section_text
from looktwice.service.planning.telling import PlanTeller, Written
from looktwice.service.planning.wire_answers import plan_answer, wire_branch

_EVERY: Final = 5
"""Of the poses at 10 Hz, a message tells one in so many: every half second."""


class Completion:
    """Makes the answers to one chat.

    Args:
        completion_id: of this answer.
        model: that answers.
        chat: what was asked.
    """

    def __init__(self, completion_id: str, model: str, chat: ChatRequest) -> None:
        self._chat = chat
        self._told: dict[int, str] = {}
        self._head = {
            "id": f"chatcmpl-{completion_id}",
            "created": int(time.time()),
            "model": model,
        }
        self._request_id = completion_id

    def whole(self, planned: PlannedScene, teller: PlanTeller) -> dict[str, Any]:
        """The answer at once; ``teller`` tells of its format."""
        answer = plan_answer(planned, self._request_id)
        choices = [
            {
                "index": draw.index,
                "message": {"role": "assistant", "content": self._content(draw, teller)} | self._extra(draw),
                "finish_reason": "stop",
                "logprobs": None,
            }
            for draw in answer.draws
        ]
        told = {"choices": choices, "usage": self._usage(planned), "looktwice": _outcome(answer)}
        return self._head | {"object": "chat.completion"} | told

    def delta(self, name: str, part: Written) -> dict[str, Any] | None:
        """What a part of a draw adds to its choice; None where it adds nothing."""
        # Clients join deltas field by field, so the role is told once.
        role = {} if part.index in self._told else {"role": "assistant"}
        content = self._more(name, part)
        if not content:
            return None
        return self._chunk([{"index": part.index, "delta": role | {"content": content}}])

    def last(self, planned: PlannedScene) -> list[dict[str, Any]]:
        """What ends a stream."""
        answer = plan_answer(planned, self._request_id)
        choices = [
            {"index": draw.index, "delta": self._extra(draw), "finish_reason": "stop"}
            for draw in answer.draws
        ]
        chunks = [self._chunk(choices) | {"looktwice": _outcome(answer)}]
        options = self._chat.stream_options
        if options is not None and options.include_usage:
            chunks.append(self._chunk([]) | {"usage": self._usage(planned)})
        return chunks

    def _content(self, draw: wire.Draw, teller: PlanTeller) -> str:
        """A whole message: what a stream adds up to."""
        return "".join(self._more(name, part) for name, part in teller.finished(draw))

    def _more(self, name: str, part: Written) -> str:
        """What a part of a draw adds to its message, on a line of its own; but words go on where they are."""
        text, told = _text_of(name, part), self._told.get(part.index, "")
        if not text:
            return ""
        goes_on = not told or told.endswith("\n") or isinstance(part, wire.ThinkingWritten)
        self._told[part.index] = text
        return text if goes_on else f"\n{text}"

    def _chunk(self, choices: list[dict[str, Any]]) -> dict[str, Any]:
        return self._head | {"object": "chat.completion.chunk", "choices": choices}

    def _extra(self, draw: wire.Draw) -> dict[str, Any]:
        assumed = [] if self._chat.looktwice.history is not None else ["history"]
        return {"looktwice": draw.model_dump() | {"assumed": assumed}}

    def _usage(self, planned: PlannedScene) -> dict[str, int]:
        written = sum(sum(draw.tokens.values()) for draw in planned.draws)
        prompt = planned.prompt_tokens()
        return {"prompt_tokens": prompt, "completion_tokens": written, "total_tokens": prompt + written}


def _outcome(answer: wire.PlanResponse) -> dict[str, Any]:
    """What an answer says beside its draws."""
    return answer.model_dump(include={"deadline", "agreed", "timing"})


def _text_of(name: str, part: Written) -> str:
    """A part of a draw as text, by its kind: a plan, an option, words, a section or a trajectory."""
    match part:
        case wire.PlanWritten():
            return part.plan.text
        case wire.BranchTaken() if part.branch == wire_branch(looked_twice=True):
            return f"{part.branch} "
        case wire.ThinkingWritten():
            return part.text
        case wire.SectionWritten():
            text = section_text(part.section.name, part.section.values)
            return f"{text}\n" if text else ""
        case wire.TrajectoryWritten() if name != "draft_trajectory":
            return _trajectory_text(part.trajectory, part.times_s)
    return ""


def _trajectory_text(trajectory: list[list[float]], times_s: list[float] | None) -> str:
    """A trajectory as a line of text: x and y in m, heading in rad, every half second or at its own times."""
    told = trajectory[_EVERY - 1 :: _EVERY] if times_s is None else trajectory
    rows = [[round(x, 2), round(y, 2), round(heading, 3)] for x, y, _, heading in told]
    return f"Trajectory: {json.dumps(rows)}\n"
