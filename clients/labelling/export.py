"""What a build is for: reflections to train on, in our own form and in that of other trainers."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final, get_args

from looktwice.clients import wire
from looktwice.clients.labelling.build_outcomes import followed_plans, plans_that_hold
from looktwice.clients.labelling.ledger import Entry, Ledger, LedgerError, StageRun
from looktwice.clients.labelling.teachers.prompt import camera_line
from looktwice.model.driving.images import media_type
from looktwice.model.driving.mends import Mend, mend_within
from looktwice.model.driving.phrases import corrected, facts_of
from looktwice.model.driving.plan import parse_plan
from looktwice.model.driving.reflection_store import LabelledReflection
from looktwice.model.driving.scene import Scene
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.trajectory import present_speed
from looktwice.model.driving.whole_files import written_whole

MESSAGES_FILE: Final = "messages.jsonl"
PARTS_FILE: Final = "trl.jsonl"
_IMAGE: Final = "<image>"
_, _REFLECTS = get_args(wire.Branch)
"""What a second look begins with."""
DATASET: Final = "looktwice"


def reflections(ledger: Ledger, label: StageRun, *, by_outcome: bool = False) -> Iterator[LabelledReflection]:
    """What a teacher wrote, with its provenance, scene by scene.

    A reflection in phrases leads to the better plan in the tracks that it speaks of; the others stay as the
    model planned them.

    Args:
        ledger, label: where the labels are.
        by_outcome: plans that failed when they were followed deserve a second look. Of all others it is not
            known: their reflections teach how to think, not whether to.
    """
    rollout = _rollout_of(ledger, label)
    for entry in ledger.entries(label):
        predicted, expert = (parse_plan(entry.record[f"{name}_plan"]) for name in ("predicted", "expert"))
        facts = facts_of(entry.record["reflection"])
        led: Mend = entry.record.get("mend") or "the expert's"
        mend = led if facts is None else mend_within(led, facts.groups)
        yield LabelledReflection(
            scene_id=entry.scene_id,
            predicted_plan=predicted,
            reflection=entry.record["reflection"],
            expert_plan=expert if facts is None else corrected(predicted, expert, facts),
            mend=mend or "",
            judged=not by_outcome or entry.record["failure"] is not None,
            key=entry.key,
            **_planned_by(rollout),
            teacher=label.config["teacher"],
            teacher_revision=label.config["revision"],
            attempts=entry.record["attempts"],
            labelled_at=entry.ended_at,
        )


def right_plans(ledger: Ledger, label: StageRun, plan_iou: float) -> Iterator[LabelledReflection]:
    """The model's own plans that agree with the expert's, at least so much: nothing is to be corrected there.

    They come from all scenes of the labels' rollout, whatever the filter kept; plans that were labelled are
    left out, since their reflections say to correct them.
    """
    rollout = _rollout_of(ledger, label)
    labelled = {(entry.record["rollout"], entry.record["predicted_plan"]) for entry in ledger.entries(label)}
    for entry in ledger.entries(rollout):
        right = dict.fromkeys(draw["plan"] for draw in entry.record["free"] if draw["plan_iou"] >= plan_iou)
        yield from _to_act_on(rollout, entry, (plan for plan in right if (entry.key, plan) not in labelled))


def held_plans(ledger: Ledger, label: StageRun) -> Iterator[LabelledReflection]:
    """The model's own plans that hold when they are followed, from all scenes of the labels' rollout.

    Raises:
        LedgerError: no plan of that rollout was followed.
    """
    rollout = _rollout_of(ledger, label)
    followed = followed_plans(ledger, rollout)
    for entry in ledger.entries(rollout):
        if entry.key in followed:
            free = entry.record["free"]
            held = (free[draw]["plan"] for draw in plans_that_hold(entry, followed[entry.key]))
            yield from _to_act_on(rollout, entry, held)


def _to_act_on(rollout: StageRun, entry: Entry, plans: Iterable[str]) -> Iterator[LabelledReflection]:
    """Plans of a rolled-out scene with no reflection on them."""
    expert = parse_plan(entry.record["expert_plan"])
    for plan in plans:
        yield LabelledReflection(
            scene_id=entry.scene_id,
            predicted_plan=parse_plan(plan),
            reflection="",
            expert_plan=expert,
            mend="",
            judged=True,
            key=entry.key,
            **_planned_by(rollout),
            teacher="",
            teacher_revision="",
            attempts=0,
            labelled_at=entry.ended_at,
        )


def _planned_by(rollout: StageRun) -> dict[str, Any]:
    """Whose plans they are, and what it was told."""
    config = rollout.config
    told = {name: config[name] for name in ("route", "tracks")}
    return {"model": config["model"], "model_revision": config["revision"], **told}


def _rollout_of(ledger: Ledger, label: StageRun) -> StageRun:
    rollout = next((run for run in ledger.runs("rollout") if run.id == label.config["rollout"]), None)
    if rollout is None:
        raise LedgerError("the labels' rollout is not in the ledger")
    return rollout


def write_messages(ledger: Ledger, label: StageRun, scenes: Path, folder: Path) -> int:
    """Write a data set of messages and images, in the form of LLaMA-Factory and in TRL's; returns its length.

    One wants a tag in the text for each image, the other parts: it would take a tag for text.
    The scene and the plan to be corrected are the user's, the reflection and the better plan the
    assistant's: so a trainer that learns what assistants say leaves the wrong plan out by itself.
    """
    by_scene: dict[str, list[LabelledReflection]] = {}
    for each in reflections(ledger, label):
        by_scene.setdefault(each.scene_id, []).append(each)
    pictures = folder / "images"
    pictures.mkdir(parents=True, exist_ok=True)
    count = 0
    with (
        written_whole(folder / MESSAGES_FILE) as tagged,
        written_whole(folder / PARTS_FILE) as parted,
        written_whole(folder / "dataset_info.json") as info,
        tagged.open("w") as tagged_lines,
        parted.open("w") as parted_lines,
    ):
        for labelled in read_scenes(scenes, dense=False, unlabelled=lambda _: None):
            for each in by_scene.pop(labelled.scene.scene_id, []):
                row = _row(labelled.scene, each, _write_images(labelled.scene, pictures))
                tagged_lines.write(json.dumps(row) + "\n")
                parted_lines.write(json.dumps(_in_parts(row)) + "\n")
                count += 1
        if by_scene:
            raise LedgerError(f"{len(by_scene)} labelled scenes are not at {scenes}, such as {min(by_scene)}")
        info.write_text(json.dumps(_DATASET_INFO, indent=2) + "\n")
    return count


_DATASET_INFO: Final = {
    DATASET: {
        "file_name": MESSAGES_FILE,
        "formatting": "sharegpt",
        "columns": {"messages": "messages", "images": "images"},
        "tags": {
            "role_tag": "role",
            "content_tag": "content",
            "user_tag": "user",
            "assistant_tag": "assistant",
        },
    }
}


def _write_images(scene: Scene, folder: Path) -> list[str]:
    """A scene's pictures as files, by name relative to the data set."""
    names = []
    for clip in scene.clips:
        for number, image in enumerate(clip.images):
            name = f"{_file_name(scene.scene_id)}-{clip.camera}-{number}{_suffix(image)}"
            (folder / name).write_bytes(image)
            names.append(f"{folder.name}/{name}")
    return names


def _row(scene: Scene, labelled: LabelledReflection, images: list[str]) -> dict[str, Any]:
    cameras = "\n".join(f"{camera_line(clip)}\n{_IMAGE * len(clip.images)}" for clip in scene.clips)
    asked = (
        f"{cameras}\nYou drive at {present_speed(scene.history):.1f} m/s.\n"
        f"Your plan for the next 6.4 seconds:\n{labelled.predicted_plan}"
        "Reflect on it, then correct it."
    )
    answered = f"{_REFLECTS}\n{labelled.reflection}\nMeta Actions:\n{labelled.expert_plan}"
    return {
        "messages": [
            {"role": "user", "content": asked},
            {"role": "assistant", "content": answered.rstrip("\n")},
        ],
        "images": images,
        "scene_id": labelled.scene_id,
        "key": labelled.key,
    }


def _in_parts(row: dict[str, Any]) -> dict[str, Any]:
    """A row whose messages are parts: texts, and places for the images in their order."""

    def parts(content: str) -> list[dict[str, str]]:
        found: list[dict[str, str]] = []
        for number, text in enumerate(content.split(_IMAGE)):
            found += [{"type": "image"}] * (number > 0)
            found += [{"type": "text", "text": text}] if text else []
        return found

    return row | {"messages": [each | {"content": parts(each["content"])} for each in row["messages"]]}


def _file_name(scene_id: str) -> str:
    """A scene's id as part of a file's name."""
    return "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in scene_id)


def _suffix(image: bytes) -> str:
    return {"image/jpeg": ".jpg", "image/png": ".png", "image/webp": ".webp"}[media_type(image)]
