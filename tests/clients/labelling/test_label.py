from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from looktwice.clients.labelling import build_outcomes
from looktwice.clients.labelling.batch_api import BatchError, batch_requests, read_results, take_results
from looktwice.clients.labelling.checks import FailedCheck
from looktwice.clients.labelling.export import DATASET, PARTS_FILE, reflections, right_plans, write_messages
from looktwice.clients.labelling.label import LabelTask, config_of, jobs, labeller, predicted_plans, questions
from looktwice.clients.labelling.ledger import Entry, Ledger, LedgerError, StageRun
from looktwice.clients.labelling.pipeline import Job, StageLimits, StageStopped, Tally, work_through
from looktwice.clients.labelling.teachers.openai import OpenAiSettings, OpenAiTeacher
from looktwice.clients.labelling.teachers.prompt import Text, user_message
from looktwice.clients.labelling.teachers.rules import RuleTeacher
from looktwice.clients.labelling.teachers.teacher import (
    Answer,
    Question,
    Teacher,
    TeacherClosed,
    TeacherError,
)
from looktwice.model.driving.outcome import Outcome
from looktwice.model.driving.plan import parse_plan
from looktwice.model.driving.reflection_store import ReflectionFileError, read_reflections, write_reflections
from looktwice.model.driving.scene_store import read_scenes, write_scenes
from tests.clients.labelling.builds import (
    GOOD,
    LEAKING,
    completion,
    rolled_out,
    rollout_record,
    scenes,
)
from tests.service.scripted_engine import KEEP_ON, SLOW_DOWN

SCENES = 5


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return scenes(tmp_path, SCENES)


@pytest.fixture
def ledger(tmp_path: Path) -> Iterator[Ledger]:
    rolled_out(tmp_path / "build", SCENES)
    with Ledger(tmp_path / "build") as opened:
        yield opened


class Scripted:
    """A teacher with one thing to say, or to raise."""

    name, revision = "scripted", "1"

    def __init__(self, answer: Answer | Exception) -> None:
        self.answer, self.asked = answer, 0

    async def reflect(self, question: Question, complaints: Sequence[FailedCheck] = ()) -> Answer:
        self.asked += 1
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer

    async def close(self) -> None:
        pass


def labelled(ledger: Ledger, file: Path, teacher: Teacher, *, plans: int = 1) -> tuple[StageRun, Tally]:
    rollout = ledger.the_run("rollout")
    run = ledger.run("label", config_of(rollout, teacher, 0))
    found = jobs(run, questions(ledger, rollout, file, plans_per_scene=plans))
    limits = StageLimits(max_error_rate=1.0, give_up_after_s=1.0)
    return run, asyncio.run(work_through(ledger, run, found, labeller(ledger, run, teacher), limits))


def test_every_kept_scene_is_asked_about(ledger: Ledger, file: Path) -> None:
    rollout = ledger.the_run("rollout")
    kept = [entry.key for entry in ledger.entries(rollout)][:3]
    ledger.select(rollout, [(key, (0,)) for key in kept])
    run, tally = labelled(ledger, file, RuleTeacher())
    assert (tally.done, tally.dead) == (3, 0)
    assert {entry.record["rollout"] for entry in ledger.entries(run)} == set(kept)
    for entry in ledger.entries(run):
        assert entry.record["predicted_plan"] == str(KEEP_ON)
        assert entry.record["expert_plan"] == str(SLOW_DOWN)
        assert (entry.record["attempts"], entry.record["failed_checks"]) == (1, [])


class Attentive(Scripted):
    """Remembers its questions."""

    def __init__(self) -> None:
        super().__init__(Answer(GOOD))
        self.questions: list[Question] = []

    async def reflect(self, question: Question, complaints: Sequence[FailedCheck] = ()) -> Answer:
        self.questions.append(question)
        return await super().reflect(question, complaints)


def test_a_question_tells_what_its_plan_failed_at(ledger: Ledger, file: Path) -> None:
    teacher = Attentive()
    run, _ = labelled(ledger, file, teacher)
    assert {question.outcome for question in teacher.questions} == {None}

    rollout = ledger.the_run("rollout")
    followed = ledger.run("outcomes", build_outcomes.config_of(rollout))
    holds = Outcome((), None, None, None, None, None, None, 60.0, 60.0)
    late = replace(holds, fails=("behind",), driven_m=42.0)
    eased = parse_plan("- longitudinal\n  - 0.0s-3.0s: Decelerate\n  - 3.0s-6.4s: Keep Speed\n")
    mended = str(replace(KEEP_ON, longitudinal=eased.longitudinal))
    for entry, first in zip(ledger.entries(rollout), (late, late, holds), strict=False):
        mend = None if first.holds else {"mend": "ease off", "plan": mended}
        record = {
            "rollout": entry.key,
            "expert": holds.to_json(),
            "plans": [first.to_json(), holds.to_json()],
            "mends": [mend, None],
        }
        ledger.finish(followed, f"o-{entry.key}", entry.scene_id, record)
    again = Attentive()
    _, tally = labelled(ledger, file, again)
    assert (tally.done, tally.earlier) == (2, SCENES - 2), "another hint is another question"
    assert {question.outcome for question in again.questions} == {late}
    assert {str(question.expert) for question in again.questions} == {mended}, "the mended plan is better"
    told = [entry.record["failure"] for entry in ledger.entries(run)]
    assert sorted(told, key=str) == [None] * SCENES + ["falls behind by 18 m"] * 2
    assert {each.judged for each in reflections(ledger, run)} == {True}
    judged = [each.judged for each in reflections(ledger, run, by_outcome=True)]
    assert sorted(judged) == [False] * SCENES + [True] * 2, "only of a plan that failed it is known"
    led = {each.mend: each.expert_plan for each in reflections(ledger, run)}
    assert set(led) == {"ease off", "the expert's"}
    assert str(led["ease off"]) == mended
    parts = user_message(again.questions[0], (), "free_text")
    assert any(isinstance(part, Text) and "your plan falls behind by 18 m" in part.text for part in parts)
    parts = user_message(teacher.questions[0], (), "free_text")
    assert not any(isinstance(part, Text) and "A hint" in part.text for part in parts)


def test_plans_are_chosen_by_chance_once_and_for_all() -> None:
    record = rollout_record()
    record["free"] = [{**record["free"][0], "plan": str(plan)} for plan in (KEEP_ON, SLOW_DOWN, KEEP_ON)]
    entries = [Entry(f"key {number}", "scene", "done", record, "") for number in range(40)]
    firsts = [predicted_plans(entry, range(3), 1, 0) for entry in entries]
    assert firsts == [predicted_plans(entry, range(3), 1, 0) for entry in entries]
    assert {text for texts in firsts for text in texts} == {str(KEEP_ON), str(SLOW_DOWN)}
    more = [predicted_plans(entry, range(3), 9, 0) for entry in entries]
    assert [plans[:1] for plans in more] == firsts
    assert {len(plans) for plans in more} == {2}
    assert predicted_plans(entries[0], [1], 9, 0) == [str(SLOW_DOWN)], "only draws that were kept"


def test_rubbish_is_asked_again_and_then_buried(ledger: Ledger, file: Path) -> None:
    teacher = Scripted(Answer(LEAKING, 10, 5, 0.01))
    run, tally = labelled(ledger, file, teacher)
    assert (tally.done, tally.dead, teacher.asked) == (0, SCENES, 3 * SCENES)
    assert ledger.spent(run)[:3] == (3 * SCENES, 30 * SCENES, 15 * SCENES)
    letter = next(iter(ledger.entries(run, "dead"))).record
    assert letter["text"] == LEAKING
    assert "leak" in letter["reason"]
    assert labelled(ledger, file, teacher)[1].earlier == SCENES
    assert teacher.asked == 3 * SCENES, "dead letters are not asked again by themselves"


def test_a_teacher_that_lacks_something_writes_dead_letters(ledger: Ledger, file: Path) -> None:
    assert labelled(ledger, file, Scripted(TeacherError("no annotations")))[1].dead == SCENES


def test_a_closed_teacher_stops_it(ledger: Ledger, file: Path) -> None:
    with pytest.raises(StageStopped, match="wrong key"):
        labelled(ledger, file, Scripted(TeacherClosed("wrong key")))
    assert ledger.runs("label") == []


def test_labels_of_another_teacher_are_others(ledger: Ledger, file: Path) -> None:
    labelled(ledger, file, RuleTeacher())
    assert labelled(ledger, file, Scripted(Answer(GOOD)))[1].done == SCENES
    with pytest.raises(LedgerError, match="several runs"):
        ledger.the_run("label")


def test_scenes_whose_annotations_have_changed_are_asked_about_anew(ledger: Ledger, file: Path) -> None:
    assert labelled(ledger, file, RuleTeacher())[1].done == SCENES
    tagged, repainted, *same = read_scenes(file)
    (agent, *others) = repainted.agents
    changed = [
        replace(tagged, tags=tagged.tags ^ {"turn"}),
        replace(repainted, agents=(replace(agent, width_m=agent.width_m + 0.1), *others)),
    ]
    write_scenes(file, iter([*changed, *same]))
    again = labelled(ledger, file, RuleTeacher())[1]
    assert (again.done, again.earlier) == (2, SCENES - 2)


def test_reflections_come_out_with_their_provenance(ledger: Ledger, file: Path, tmp_path: Path) -> None:
    run, _ = labelled(ledger, file, RuleTeacher())
    target = tmp_path / "reflections.parquet"
    assert write_reflections(target, reflections(ledger, run)) == SCENES
    read = list(read_reflections(target))
    assert {each.scene_id for each in read} == {f"scene-{number:04d}" for number in range(SCENES)}
    one = read[0]
    assert (one.predicted_plan, one.expert_plan) == (KEEP_ON, SLOW_DOWN)
    assert (one.model, one.model_revision, one.teacher, one.teacher_revision) == (
        *("scripted", "r1"),
        *("rules", RuleTeacher.revision),
    )
    assert one.labelled_at.endswith("Z")
    assert ledger.has(one.key)
    target.write_bytes(target.read_bytes()[:-20])
    with pytest.raises(ReflectionFileError):
        list(read_reflections(target))
    with pytest.raises(ReflectionFileError, match="no reflections"):
        list(read_reflections(file))


def test_right_plans_come_out_of_all_scenes_without_words(ledger: Ledger, file: Path, tmp_path: Path) -> None:
    run, _ = labelled(ledger, file, RuleTeacher())
    (rollout,) = ledger.runs("rollout")
    least = max(draw["plan_iou"] for entry in ledger.entries(rollout) for draw in entry.record["free"])
    target = tmp_path / "reflections.parquet"
    count = write_reflections(target, right_plans(ledger, run, least))
    read = list(read_reflections(target))
    assert 0 < count == len(read)
    assert all(not each.reflection and not each.teacher and each.model == "scripted" for each in read)
    assert list(right_plans(ledger, run, 1.1)) == []
    looked_at = {(each.scene_id, str(each.predicted_plan)) for each in reflections(ledger, run)}
    acted_on = {(each.scene_id, str(each.predicted_plan)) for each in right_plans(ledger, run, 0.0)}
    assert looked_at
    assert acted_on
    assert not looked_at & acted_on, "one plan cannot be both"


def test_messages_are_what_trainers_read(ledger: Ledger, file: Path, tmp_path: Path) -> None:
    run, _ = labelled(ledger, file, Scripted(Answer(GOOD)))
    folder = tmp_path / "messages"
    assert write_messages(ledger, run, file, folder) == SCENES
    info = json.loads((folder / "dataset_info.json").read_text())[DATASET]
    rows = [json.loads(line) for line in (folder / info["file_name"]).read_text().splitlines()]
    assert len(rows) == SCENES
    for row in rows:
        user, assistant = row["messages"]
        assert (user["role"], assistant["role"]) == ("user", "assistant")
        assert user["content"].count("<image>") == len(row["images"]) == 8
        assert all((folder / image).read_bytes()[:2] == b"\xff\xd8" for image in row["images"])
        assert str(KEEP_ON) in user["content"]
        assert GOOD in assistant["content"]
        assert "expert" not in user["content"] + assistant["content"]
        assert str(SLOW_DOWN).strip() in assistant["content"]
    parted = [json.loads(line) for line in (folder / PARTS_FILE).read_text().splitlines()]
    for row, other in zip(rows, parted, strict=True):
        assert other["images"] == row["images"]
        for message, (role, parts) in zip(row["messages"], map(dict.values, other["messages"]), strict=True):
            assert role == message["role"]
            texts = [part.get("text", "<image>") for part in parts]
            assert "".join(texts) == message["content"]
            assert [part["type"] for part in parts].count("image") == message["content"].count("<image>")
    with pytest.raises(LedgerError, match="not at"):
        write_messages(ledger, run, scenes(tmp_path / "fewer", 2), folder)


SETTINGS = OpenAiSettings("https://api.example/v1", "some-vlm", api_key="sk-secret")


def in_batch(ledger: Ledger, file: Path) -> tuple[StageRun, list[Job[LabelTask]]]:
    rollout = ledger.the_run("rollout")
    run = ledger.run("label", config_of(rollout, OpenAiTeacher(SETTINGS), 0))
    return run, list(jobs(run, questions(ledger, rollout, file)))


def results(asked: list[dict[str, object]], *texts: str | None) -> dict[str, Answer]:
    """What a batch gives back, in another order; None for a request that failed."""
    lines = [
        json.dumps(
            {
                "id": "batch_req_1",
                "custom_id": one["custom_id"],
                "response": None
                if text is None
                else {"status_code": 200, "request_id": "r", "body": completion(text)},
                "error": {"code": "expired", "message": "too late"} if text is None else None,
            }
        )
        for one, text in zip(asked, texts, strict=True)
    ]
    return read_results(reversed(lines), SETTINGS)


def test_a_batch_goes_out_and_comes_back(ledger: Ledger, file: Path) -> None:
    run, found = in_batch(ledger, file)
    asked = list(batch_requests(ledger, found, SETTINGS))
    assert len({line["custom_id"] for line in asked}) == SCENES
    assert all((line["method"], line["url"]) == ("POST", "/v1/chat/completions") for line in asked)
    assert all(line["body"]["model"] == "some-vlm" for line in asked)
    assert "sk-secret" not in json.dumps(asked)

    first = take_results(ledger, run, found, results(asked, GOOD, GOOD, LEAKING, LEAKING, None))
    assert (first.done, first.dead) == (2, 0)
    again = list(batch_requests(ledger, found, SETTINGS))
    assert len(again) == 3
    told = [json.dumps(line).count("cannot be used. This time") for line in again]
    assert sorted(told) == [0, 1, 1], "those that leaked are told, the one that failed is asked anew"

    same = take_results(ledger, run, found, results(asked, GOOD, GOOD, LEAKING, LEAKING, None))
    assert (same.done, same.earlier) == (0, 2), "results taken twice count once"
    second = take_results(ledger, run, found, results(again, GOOD, LEAKING, GOOD))
    assert second.done == 2
    last = list(batch_requests(ledger, found, SETTINGS))
    third = take_results(ledger, run, found, results(last, LEAKING))
    assert (third.done, third.dead) == (0, 1)
    assert list(batch_requests(ledger, found, SETTINGS)) == []
    assert (ledger.count(run), ledger.count(run, "dead")) == (SCENES - 1, 1)


def test_lines_that_are_no_results_are_named() -> None:
    with pytest.raises(BatchError, match="line 2"):
        read_results(['{"custom_id": "a-1", "error": {}}', "{}"], SETTINGS)
    assert read_results(["", "\n"], SETTINGS) == {}
