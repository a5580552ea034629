from __future__ import annotations

import asyncio
import base64
import re
import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from looktwice.model.driving.scene import NextFrame
from looktwice.model.driving.scene_store import write_scenes
from looktwice.service.operations.settings import Settings
from looktwice.service.problems import ProblemError
from looktwice.service.scenes import files
from looktwice.service.scenes.bundled import BundledScenes, view
from looktwice.service.scenes.files import scenes_of_file
from tests.service.http.test_problem_documents import problem
from tests.service.scenes import labelled
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served, serve


def test_a_view_tells_everything_the_page_draws() -> None:
    shown, original = view(labelled()), labelled()
    assert base64.b64decode(shown.scene.clips[1].images[3]) == original.scene.clips[1].images[3]
    assert np.allclose(shown.scene.history, original.scene.history, atol=1e-3)
    assert np.allclose(shown.future, original.future, atol=1e-3)
    assert np.allclose(shown.drivable[0], original.drivable[0])
    assert len(shown.lane_lines) == 4
    assert shown.tags == ["lane_change", "lead_vehicle"]
    leader, _, walker = shown.agents
    assert (leader.kind, leader.length_m, leader.poses[15]) == ("vehicle", 4.5, [24.0, 0.0, 0.0])
    assert walker.poses[:4] == [None] * 4, "absent is null: JSON has no NaN"
    assert walker.poses[4] is not None


def test_what_cameras_saw_next_is_told() -> None:
    picture = labelled().scene.clips[0].images[0]
    shown = view(replace(labelled(), next_frames=(NextFrame("back_left", picture),)))
    [told] = shown.next_images
    assert (told.camera, base64.b64decode(told.image)) == ("back_left", picture)
    assert view(labelled()).next_images == []


def test_bundled_scenes_can_be_planned_for_as_they_come(served: Served, engine: ScriptedEngine) -> None:
    entries = served.http.get("/v1/scenes").json()["scenes"]
    assert [entry["scene_id"] for entry in entries] == ["slow-leader", "second/scene"]
    assert entries[0]["tags"] == ["lane_change", "lead_vehicle"]
    for entry in entries:
        shown = served.http.get(f"/v1/scenes/{entry['scene_id'].replace('/', '%2F')}").json()
        assert served.http.post("/v1/plan", json={"scene": shown["scene"]}).status_code == 200
    assert [request.scene.scene_id for request in engine.submitted] == ["slow-leader", "second/scene"]


def test_an_unknown_scene(served: Served) -> None:
    problem(served.http.get("/v1/scenes/nobody"), "unknown-scene")


def test_no_bundled_scenes_are_an_empty_list(engine: ScriptedEngine, tmp_path: Path) -> None:
    with serve(engine, Settings(bundled_scenes=tmp_path / "none.parquet")) as served:
        assert served.http.get("/v1/scenes").json() == {"scenes": []}
        problem(served.http.get("/v1/scenes/any"), "unknown-scene")


def test_damaged_bundled_scenes_are_told(engine: ScriptedEngine, scene_file: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.parquet"
    damaged.write_bytes(scene_file.read_bytes()[:-100])
    with serve(engine, Settings(bundled_scenes=damaged)) as served:
        found = problem(served.http.get("/v1/scenes"), "scenes-unreadable")
        assert "truncated" in found.detail
        assert str(tmp_path) not in found.detail, "paths of the server are nobody's business"
        served.until_ready()


def test_bundled_scenes_are_read_once(scene_file: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.parquet"
    copy.write_bytes(scene_file.read_bytes())
    scenes = BundledScenes(copy)
    first = scenes.all()
    copy.unlink()
    assert scenes.all() is first


def test_an_uploaded_file(served: Served, scene_file: Path) -> None:
    answer = served.http.post("/v1/scenes:read", content=scene_file.read_bytes())
    assert answer.status_code == 200
    first, second = answer.json()["scenes"]
    assert first == served.http.get("/v1/scenes/slow-leader").json()
    assert second["scene"]["scene_id"] == "second/scene"


def test_a_truncated_file_says_so(served: Served, scene_file: Path) -> None:
    for kept in (0, 1, 1000, -1):
        content = scene_file.read_bytes()[:kept]
        found = problem(served.http.post("/v1/scenes:read", content=content), "invalid-scene-file")
        assert found.detail.startswith("the file is not a whole Parquet file (truncated?)")


def test_a_damaged_page_says_so(scene_file: Path, tmp_path: Path) -> None:
    content = bytearray(scene_file.read_bytes())
    footer = int.from_bytes(content[-8:-4], "little") + 8
    content[4:-footer] = bytes(len(content) - 4 - footer)
    with pytest.raises(ProblemError, match="the file is damaged"):
        scenes_of_file(_kept(tmp_path, bytes(content)))


def _kept(folder: Path, content: bytes) -> Path:
    path = folder / "kept.parquet"
    path.write_bytes(content)
    return path


def rewritten(path: Path, metadata: dict[bytes, bytes] | None) -> bytes:
    table = pq.read_table(path).replace_schema_metadata(metadata)
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    content: bytes = sink.getvalue().to_pybytes()
    return content


def test_another_version_says_so(served: Served, scene_file: Path) -> None:
    content = rewritten(scene_file, {b"looktwice.scene_version": b"99"})
    found = problem(served.http.post("/v1/scenes:read", content=content), "invalid-scene-file")
    assert "version 99" in found.detail


def test_another_parquet_file_says_so(served: Served, scene_file: Path) -> None:
    content = rewritten(scene_file, None)
    found = problem(served.http.post("/v1/scenes:read", content=content), "invalid-scene-file")
    assert "no LookTwice scenes" in found.detail


def test_a_file_that_would_fill_the_memory(scene_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "MAX_UNPACKED_BYTES", 1000)
    with pytest.raises(ProblemError, match="the file would unpack to"):
        scenes_of_file(scene_file)


def test_a_file_with_too_many_scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "many.parquet"
    write_scenes(path, (labelled(str(number)) for number in range(4)))
    monkeypatch.setattr(files, "MAX_SCENES_SHOWN", 3)
    assert len(scenes_of_file(path)) == 3
    monkeypatch.setattr(files, "MAX_SCENES_IN_FILE", 3)
    with pytest.raises(ProblemError, match="more than 3 scenes"):
        scenes_of_file(path)


def bomb(scene_file: Path, images: int) -> bytes:
    """A scene file of some kB whose first clip has so many pictures, all of them the same 8 kB."""
    rows = pq.read_table(scene_file)
    first = rows.slice(0, 1).to_pylist()
    for clip in first[0]["clips"]:
        clip["images"] = [bytes(8000)] * images
    table = pa.Table.from_pylist(first, schema=rows.schema)
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", use_dictionary=True, write_page_checksum=True)
    content: bytes = sink.getvalue().to_pybytes()
    return content


def test_a_small_file_that_holds_gigabytes_is_refused(served: Served, scene_file: Path) -> None:
    content = bomb(scene_file, 100_000)
    assert len(content) < 200_000
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found = problem(served.http.post("/v1/scenes:read", content=content), "invalid-scene-file")
    assert "memory" in found.detail
    # The service itself took none of it, and reads the next one.
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < 200_000
    assert served.http.post("/v1/scenes:read", content=scene_file.read_bytes()).status_code == 200


def test_a_file_with_much_to_tell_is_refused(
    scene_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(files, "MAX_ANSWER_BYTES", 1000)
    monkeypatch.setattr(resource, "setrlimit", lambda *_: None)
    assert files.main(scene_file) == files.REFUSED
    told = capsys.readouterr()
    assert re.fullmatch(r"the file's scenes are \d+ bytes to tell; at most 1000 are", told.err)
    assert told.out == ""


def test_a_file_that_takes_too_long_is_ended(scene_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "MAX_WAIT_S", 0.01)
    with pytest.raises(ProblemError, match=r"longer than 0\.01 s"):
        asyncio.run(files.read_scene_file(scene_file.read_bytes()))
