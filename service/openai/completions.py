"""Plans as chat completions; what the dialect has no words for is in a field ``looktwice``."""

from __future__ import annotations

import json
import time
from typing import Any, Final

import looktwice.clients.wire as wire
from looktwice.service.openai.chat_requests import ChatRequest
from looktwice.service.planning.events import PlannedScene
from looktwice.service.planning.wire_answers import plan_answer, wire_branch

THINKING: Final = f"{wire_branch(looked_twice=True)} "
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

    def whole(self, planned: PlannedScene) -> dict[str, Any]:
        """The answer at once."""
        answer = plan_answer(planned, self._request_id)
        choices = [
            {
                "index": draw.index,
                "message": {"role": "assistant", "content": text_of(draw)} | self._extra(draw),
                "finish_reason": "stop",
                "logprobs": None,
            }
            for draw in answer.draws
        ]
        told = {"choices": choices, "usage": self._usage(planned), "looktwice": _outcome(answer)}
        return self._head | {"object": "chat.completion"} | told

    def delta(self, index: int, text: str, *, own_line: bool = False) -> dict[str, Any]:
        """More of one choice, on a line of its own where that is wanted; all of it makes `text_of`."""
        # Clients join deltas field by field, so the role is told once.
        role = {} if index in self._told else {"role": "assistant"}
        content = _behind(self._told.get(index, ""), text) if own_line else text
        self._told[index] = content
        return self._chunk([{"index": index, "delta": role | {"content": content}}])

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


def text_of(draw: wire.Draw) -> str:
    """A draw as a message."""
    told = "" if draw.plan is None else draw.plan.text
    if draw.thinking is not None:
        told += (THINKING if draw.branch == wire_branch(looked_twice=True) else "") + draw.thinking
    if draw.revised_plan is not None:
        told += _behind(told, draw.revised_plan.text)
    return told + _behind(told, trajectory_text(draw.trajectory, draw.times_s))


def _behind(told: str, text: str) -> str:
    """``text`` on a line of its own behind what was told."""
    return text if not told or told.endswith("\n") else f"\n{text}"


def trajectory_text(trajectory: list[list[float]], times_s: list[float] | None) -> str:
    """A trajectory as a line of text: x and y in m, heading in rad, every half second or at its own times."""
    told = trajectory[_EVERY - 1 :: _EVERY] if times_s is None else trajectory
    rows = [[round(x, 2), round(y, 2), round(heading, 3)] for x, y, _, heading in told]
    return f"Trajectory: {json.dumps(rows)}\n"
