"""OpenAI's own client against the service."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import openai
import pytest
from openai.types.chat import ChatCompletionContentPartParam, ChatCompletionMessageParam

from looktwice.clients.wire_values import wire_tracks
from looktwice.model.bundled import CHECKPOINT
from looktwice.model.driving.scene import Scene
from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.model.network.checkpoint import read_parts
from looktwice.model.network.vla_settings import VlaSettings
from looktwice.service.operations.keys import new_line
from looktwice.service.operations.settings import Settings
from looktwice.service.planning.section_text import section_text
from looktwice.service.problems import INVALID_IMAGE, at
from tests.checkpoints import made_up_tracks, noisy_scene, write_untrained
from tests.service.http.test_problem_documents import problem
from tests.service.scenes import scene
from tests.service.scripted_engine import KEEP_ON, REASONING, SLOW_DOWN, ScriptedEngine
from tests.service.serving import Served, body, serve

SCENE = body()["scene"]


@pytest.fixture
def client(served: Served) -> Iterator[openai.OpenAI]:
    with openai.OpenAI(base_url=f"{served.url}/v1", api_key="none", max_retries=0) as made:
        yield made


def messages(of: Scene | None = None) -> list[ChatCompletionMessageParam]:
    parts: list[ChatCompletionContentPartParam] = [{"type": "text", "text": "What next?"}]
    for clip in (of or scene()).clips:
        for image in clip.images:
            url = "data:image/jpeg;base64," + base64.b64encode(image).decode()
            parts.append({"type": "image_url", "image_url": {"url": url}})
    return [{"role": "system", "content": "You drive."}, {"role": "user", "content": parts}]


def extra(**fields: Any) -> dict[str, Any]:
    return {"looktwice": {"history": SCENE["history"], "route": SCENE["route"]} | fields}


@pytest.fixture(scope="module")
def families(toy_family: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[openai.OpenAI]:
    """An untrained checkpoint of families that have sections of their own, or other times."""
    settings = VlaSettings(name="own", formats=("toy", "elf_vla", "vla_world"), reflection="phrases")
    checkpoint = write_untrained(tmp_path_factory.mktemp("own") / "own", narrow=True, settings=settings)
    engine = TorchEngine(checkpoint, TorchSettings(rows=8, products=None))
    with (
        serve(engine, Settings()) as served,
        openai.OpenAI(base_url=f"{served.url}/v1", api_key="none", max_retries=0) as made,
    ):
        yield made


def asked_in(format: str, **extras: Any) -> dict[str, Any]:
    """A chat about a scene, in a response format."""
    shown = noisy_scene(1)
    looktwice = {"format": format, "history": shown.history.tolist(), "numbers": "drawn"} | extras
    return {
        "model": "own",
        "messages": messages(shown),
        "n": 2,
        "seed": 3,
        "extra_body": {"looktwice": looktwice},
    }


def streamed_contents(client: openai.OpenAI, asked: dict[str, Any]) -> dict[int, str]:
    """The message of each choice, put together from its deltas."""
    told: dict[int, str] = {}
    with client.chat.completions.create(**asked, stream=True) as stream:
        for chunk in stream:
            for choice in chunk.choices:
                told[choice.index] = told.get(choice.index, "") + (choice.delta.content or "")
    return told


def test_models_are_listed(client: openai.OpenAI) -> None:
    (model,) = client.models.list().data
    assert (model.id, model.object, model.owned_by) == ("scripted", "model", "looktwice")
    assert client.models.retrieve("scripted") == model
    with pytest.raises(openai.NotFoundError) as error:
        client.models.retrieve("gpt-4")
    assert error.value.code == "unknown-model"


def test_a_chat_is_a_plan_request(client: openai.OpenAI, served: Served, engine: ScriptedEngine) -> None:
    chat = client.chat.completions.create(
        model="scripted", messages=messages(), n=2, seed=1, extra_body=extra(thinking="always")
    )
    plain = served.http.post("/v1/plan", json=body(thinking="always")).json()
    asked, same = engine.submitted
    assert asked.scene.clips == same.scene.clips
    assert asked.scene.history.tolist() == same.scene.history.tolist()
    assert asked.controls == same.controls
    assert [choice.index for choice in chat.choices] == [0, 1]
    first = chat.choices[0]
    assert first.finish_reason == "stop"
    content = first.message.content
    assert content is not None
    plan, rest = content.split("Thinking: ")
    thinking, rest = rest.split("\n", 1)
    revised, trajectory = rest.split("Trajectory: ")
    assert (plan, thinking, revised) == (str(KEEP_ON), REASONING, str(SLOW_DOWN))
    structured = first.message.model_extra
    assert structured is not None
    draw = structured["looktwice"]
    assert draw["trajectory"] == plain["draws"][0]["trajectory"]
    assert draw["assumed"] == []
    rows = json.loads(trajectory)
    assert len(rows) == 12
    assert rows[0][:2] == pytest.approx(draw["trajectory"][4][:2], abs=0.01)
    assert chat.usage is not None
    assert chat.usage.completion_tokens == 2 * 149


def test_a_stream_adds_up_to_the_message(client: openai.OpenAI) -> None:
    whole = client.chat.completions.create(
        model="scripted", messages=messages(), n=2, extra_body=extra(thinking="always")
    )
    told, done, usage = {0: "", 1: ""}, dict[int, Any](), None
    with client.chat.completions.create(
        model="scripted",
        messages=messages(),
        n=2,
        stream=True,
        stream_options={"include_usage": True},
        extra_body=extra(thinking="always"),
    ) as stream:
        for chunk in stream:
            usage = chunk.usage or usage
            for choice in chunk.choices:
                told[choice.index] += choice.delta.content or ""
                if choice.finish_reason == "stop":
                    assert choice.delta.model_extra is not None
                    done[choice.index] = choice.delta.model_extra["looktwice"]
    for each in whole.choices:
        assert told[each.index] == each.message.content
        assert done[each.index]["thinking"] == REASONING
    assert usage == whole.usage


@pytest.mark.parametrize("thinking", ["always", "never"])
def test_a_message_says_what_only_its_format_has(families: openai.OpenAI, thinking: str) -> None:
    asked = asked_in("toy", thinking=thinking)
    chat = families.chat.completions.create(**asked)
    for choice in chat.choices:
        assert choice.message.model_extra is not None
        draw = choice.message.model_extra["looktwice"]
        [[gap_m], [turns]] = [section["values"] for section in draw["sections"]]
        poses = [[round(x, 2), round(y, 2), round(heading, 3)] for x, y, _, heading in draw["trajectory"]]
        lines = [f"Thinking: {draw['thinking']}"] if thinking == "always" else []
        lines += [
            f"Gap: {gap_m:g}",
            f"Turns: {' '.join(map(str, turns))}",
            f"Trajectory: {json.dumps(poses)}",
        ]
        assert choice.message.content == "\n".join([*lines, ""])
    assert streamed_contents(families, asked) == {each.index: each.message.content for each in chat.choices}


@pytest.mark.parametrize("format", ["elf_vla", "vla_world"])
def test_sections_stand_in_the_order_of_the_response(families: openai.OpenAI, format: str) -> None:
    asked = asked_in(format)
    chat = families.chat.completions.create(**asked)
    for choice in chat.choices:
        content, extras = choice.message.content, choice.message.model_extra
        assert content is not None
        assert extras is not None
        draw = extras["looktwice"]
        written = [each["name"] for each in draw["sections"] if section_text(each["name"], each["values"])]
        told = {name: content.index(f"{name.capitalize()}: ") for name in written}
        if draw["thinking"] is not None:
            told["think"] = content.index(draw["thinking"])
        told["answer"] = content.index("Trajectory: [[")
        assert sorted(told, key=lambda name: told[name]) == [name for name in draw["tokens"] if name in told]
        assert {place == 0 or content[place - 1] == "\n" for place in told.values()} == {True}
        assert (len(told) > 2) == (format == "vla_world")
    assert streamed_contents(families, asked) == {each.index: each.message.content for each in chat.choices}


def test_an_unknown_format_is_refused_before_the_stream_begins(client: openai.OpenAI) -> None:
    with pytest.raises(openai.BadRequestError) as error:
        client.chat.completions.create(
            model="scripted", messages=messages(), stream=True, extra_body=extra(format="haiku")
        )
    assert error.value.code == "unknown-format"


def test_the_streaming_helper_puts_the_message_together(client: openai.OpenAI) -> None:
    whole = client.chat.completions.create(model="scripted", messages=messages(), n=2, seed=3)
    with client.chat.completions.stream(model="scripted", messages=messages(), n=2, seed=3) as stream:
        stream.until_done()
        streamed = stream.get_final_completion()
    for one, other in zip(streamed.choices, whole.choices, strict=True):
        assert (one.message.role, one.message.content) == ("assistant", other.message.content)


def test_what_became_of_the_deadline_is_said(client: openai.OpenAI) -> None:
    chat = client.chat.completions.create(
        model="scripted", messages=messages(), extra_body=extra(deadline_ms=60_000)
    )
    assert chat.model_extra is not None
    assert chat.model_extra["looktwice"]["deadline"] == {"met": True, "cut": []}


def test_the_prompt_is_counted_as_it_was_given(client: openai.OpenAI) -> None:
    without, with_route = (
        client.chat.completions.create(model="scripted", messages=messages(), extra_body=body)
        for body in ({}, extra())
    )
    assert without.usage is not None
    assert with_route.usage is not None
    assert with_route.usage.prompt_tokens - without.usage.prompt_tokens == 5


def test_a_stream_says_what_became_of_the_deadline(client: openai.OpenAI) -> None:
    with client.chat.completions.create(
        model="scripted", messages=messages(), stream=True, extra_body=extra(deadline_ms=60_000)
    ) as stream:
        *_, last = stream
    assert last.model_extra is not None
    assert last.model_extra["looktwice"]["deadline"] == {"met": True, "cut": []}


def test_an_error_within_a_stream_points_at_the_chat(client: openai.OpenAI, engine: ScriptedEngine) -> None:
    engine.failure_later = at(INVALID_IMAGE, "/scene/clips/1/images/2", "/scene/clips/1/images/2 is damaged")
    stream = client.chat.completions.create(model="scripted", messages=messages(), stream=True)
    with stream, pytest.raises(openai.APIError) as error:
        list(stream)
    assert (error.value.code, error.value.type) == ("invalid-image", "invalid_request_error")
    assert error.value.param == "messages[1].content[7].image_url.url"
    assert "/scene" not in error.value.message


@pytest.mark.parametrize("path", ["/models", "/models/scripted", "/chat/completions"])
def test_openais_clients_understand_that_they_are_not_let_in(
    tmp_path: Path, engine: ScriptedEngine, path: str
) -> None:
    _, line = new_line("car")
    (tmp_path / "keys").write_text(line)
    with (
        serve(engine, Settings(api_keys_file=tmp_path / "keys"), wait=False) as served,
        openai.OpenAI(base_url=f"{served.url}/v1", api_key="wrong", max_retries=0) as client,
        pytest.raises(openai.AuthenticationError) as error,
    ):
        client.get(path, cast_to=object)
    assert (error.value.code, error.value.type) == ("unauthorized", "authentication_error")


def test_openais_clients_understand_that_it_is_not_ready() -> None:
    engine = ScriptedEngine()
    engine.may_start.clear()
    with (
        serve(engine, Settings(), wait=False) as served,
        openai.OpenAI(base_url=f"{served.url}/v1", api_key="none", max_retries=0) as client,
    ):
        for path in ("/models", "/models/scripted"):
            with pytest.raises(openai.InternalServerError) as error:
                client.get(path, cast_to=object)
            assert (error.value.code, error.value.type) == ("not-ready", "server_error")
        served.in_loop(engine.may_start.set)


def test_the_prompt_is_counted_in_each_format_as_the_network_reads_it() -> None:
    inputs = read_parts(CHECKPOINT).inputs
    with_all = replace(noisy_scene(3, route=True), tracks=made_up_tracks(3))
    scenes = [with_all, replace(with_all, route=None), replace(with_all, tracks=None)]
    with serve(TorchEngine(CHECKPOINT, TorchSettings(rows=2)), Settings()) as served:
        formats = served.engine.card.formats
        assert len(formats) > 1
        counted = set()
        for format, asked in product(formats, scenes):
            told = {"history": asked.history.tolist(), "format": format}
            told |= {} if asked.route is None else {"route": asked.route.tolist()}
            if asked.tracks is not None:
                told["tracks"] = [track.model_dump() for track in wire_tracks(asked.tracks)]
            document = {"messages": messages(asked), "looktwice": told}
            usage = served.http.post("/v1/chat/completions", json=document).json()["usage"]
            assert usage["prompt_tokens"] == len(inputs.build(asked, format).prompt.ids)
            counted.add(usage["prompt_tokens"])
        assert len(counted) > 1


def test_what_was_assumed_is_said(client: openai.OpenAI, engine: ScriptedEngine) -> None:
    chat = client.chat.completions.create(model="scripted", messages=messages())
    extras = chat.choices[0].message.model_extra
    assert extras is not None
    assert extras["looktwice"]["assumed"] == ["history"]
    assert not engine.submitted[0].scene.history.any()
    assert engine.submitted[0].controls.n == 1


@pytest.mark.parametrize(
    ("change", "slug", "param"),
    [
        ({"messages": [{"role": "user", "content": "no pictures"}]}, "invalid-clip", "messages"),
        ({"stop": ["."]}, "invalid-request", "stop"),
        ({"tools": [{"type": "function"}]}, "invalid-request", "tools"),
        ({"tool_choice": "required"}, "invalid-request", "tool_choice"),
        ({"logprobs": True}, "invalid-request", "logprobs"),
        ({"n": 65}, "invalid-request", "n"),
        ({"frequency_penalty": 0.5}, "invalid-request", "frequency_penalty"),
        ({"top_k": 20}, "invalid-request", "top_k"),
        ({"logit_bias": {"50": 1}}, "invalid-request", "logit_bias"),
        ({"response_format": {"type": "json_object"}}, "invalid-request", "response_format"),
        ({"guided_json": {"type": "object"}}, "invalid-request", "guided_json"),
        ({"structured_outputs": {"json": {}}}, "invalid-request", "structured_outputs"),
        ({"min_tokens": 5}, "invalid-request", "min_tokens"),
        ({"best_of": 4}, "invalid-request", "best_of"),
        ({"looktwice": {"speed": 3}}, "unknown-field", "looktwice.speed"),
        ({"looktwice": {"thinking": "never", "think_threshold": 0.5}}, "invalid-controls", "looktwice"),
        ({"looktwice": {"format": "haiku"}}, "unknown-format", "looktwice.format"),
        (
            {"looktwice": {"format": "traj_only", "thinking": "always"}},
            "invalid-controls",
            "looktwice.thinking",
        ),
        ({"looktwice": {"history": [[9.0, 0.0, 0.0, 0.0]] * 16}}, "invalid-history", "looktwice.history"),
    ],
)
def test_what_cannot_be_obeyed_is_refused_as_openai_does(
    client: openai.OpenAI, engine: ScriptedEngine, change: dict[str, Any], slug: str, param: str
) -> None:
    document: dict[str, Any] = {"model": "scripted", "messages": messages(), "extra_body": change}
    with pytest.raises(openai.BadRequestError) as refused:
        client.chat.completions.create(**document)
    assert (refused.value.code, refused.value.type) == (slug, "invalid_request_error")
    assert refused.value.param is not None
    assert refused.value.param.startswith(param)
    assert refused.value.body["message"]  # type: ignore[index]
    assert engine.submitted == []


def test_a_picture_that_is_none_is_pointed_at_where_it_stands(served: Served) -> None:
    document: dict[str, Any] = {"messages": messages()}
    document["messages"][1]["content"][6]["image_url"]["url"] = "data:image/jpeg;base64,AAAA"
    answer = served.http.post("/v1/chat/completions", json=document)
    assert answer.status_code == 400
    found = problem(answer, "invalid-image")
    assert found.errors[0].pointer == "/messages/1/content/6/image_url/url"
    assert answer.json()["error"]["param"] == "messages[1].content[6].image_url.url"
    assert "/scene" not in found.detail


def test_nothing_is_fetched(served: Served, engine: ScriptedEngine) -> None:
    document: dict[str, Any] = {"messages": messages()}
    document["messages"][1]["content"][1]["image_url"]["url"] = "http://169.254.169.254/latest"
    found = problem(served.http.post("/v1/chat/completions", json=document), "invalid-image")
    assert found.errors[0].pointer == "/messages/1/content/1/image_url/url"
    assert engine.submitted == []


def test_refusals_reach_the_client_as_its_own_errors(client: openai.OpenAI) -> None:
    with pytest.raises(openai.NotFoundError) as error:
        client.chat.completions.create(model="gpt-4", messages=messages())
    assert error.value.code == "unknown-model"
    assert "scripted" in str(error.value)


def test_what_says_nothing_is_let_pass(served: Served) -> None:
    said: dict[str, Any] = {
        "n": None,
        "seed": None,
        "temperature": None,
        "presence_penalty": 0.0,
        "top_k": -1,
        "logit_bias": {},
        "stop": [],
        "tools": [],
        "tool_choice": "auto",
        "response_format": {"type": "text"},
        "stream": None,
        "looktwice": None,
        "guided_json": None,
        "a field of tomorrow": 7,
    }
    document = {"model": "scripted", "messages": messages(), "user": "car-7", "max_tokens": 5} | said
    nulls = dict.fromkeys(("stop", "tools", "tool_choice", "response_format", "top_k", "logit_bias"))
    for each in (document, document | nulls):
        answer = served.http.post("/v1/chat/completions", json=each)
        assert len(answer.json()["choices"]) == 1
