"""The gate: no shortcut, batch, arrival, cancellation or chunk changes a response, in any format. In float64.

`LOOKTWICE_EXACTNESS_MIXES=200 pytest -s tests/model/engines/test_exactness.py` looks longer (with
`MALLOC_MMAP_THRESHOLD_=65536`, or what decoders free stays in holes of the memory),
`LOOKTWICE_EXACTNESS_SEED=7` at other mixes, and `LOOKTWICE_EXACTNESS_CHECKPOINT=model/bundled/looktwice-nano`
at a trained network, whose responses are shorter.
"""

from __future__ import annotations

import gc
import os
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import numpy.typing as npt
import pytest
import torch
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st

from looktwice.model.driving.plan import plan_from_bins
from looktwice.model.driving.scene import CAMERAS
from looktwice.model.engines.engine import Controls, Draw, DrawFinished, PlanRequest, Thinking
from looktwice.model.engines.sampling import probabilities
from looktwice.model.engines.torch.deadlines import TimeFor
from looktwice.model.engines.torch.decoder import Decoder, Failed
from looktwice.model.engines.torch.request import Request
from looktwice.model.engines.torch.rows import Row
from looktwice.model.engines.torch.runner import PromptPrefill, Runner
from looktwice.model.engines.torch.shortcuts import Shortcuts
from looktwice.model.families.cf_vla import CF_VLA
from looktwice.model.families.family import Attempt, Family
from looktwice.model.families.registry import OURS, families_of, family_named
from looktwice.model.formats.pieces import Format
from looktwice.model.network.checkpoint import Loaded, load, with_visual_codes
from looktwice.model.network.visual_codes import VisualCodes
from looktwice.model.network.vla_settings import NANO_SETTINGS, VlaSettings
from tests.checkpoints import copy_picture_codes, made_up_tracks, noisy_scene, write_untrained
from tests.model.engines.decoding import Again
from tests.model.engines.integrity import check_integrity
from tests.model.engines.reference import Shares, exactly, reference
from tests.model.formats.strategies import branching_formats

pytestmark = pytest.mark.filterwarnings("ignore:Generating overly large repr")

MIXES = int(os.environ.get("LOOKTWICE_EXACTNESS_MIXES", "8"))
CHECKPOINT = os.environ.get("LOOKTWICE_EXACTNESS_CHECKPOINT")
NAMES = ("cf_vla", "traj_only") if CHECKPOINT else (*OURS, "toy")
"""Formats that are mixed. A trained checkpoint has a few."""
TOGETHER = 6
"""Mixes whose plain decoding is one batch: a token a pass takes as long for a hundred draws as for ten."""
SEED = int(os.environ.get("LOOKTWICE_EXACTNESS_SEED", "0"))
VARIATIONS: list[dict[str, Any]] = [
    {},
    {"thinking": "always"},
    {"thinking": "never"},
    {"think_threshold": 0.5},
    {"prefill": plan_from_bins(np.zeros((3, 64), np.int8)), "temperature": 0.0},
]
SCENES = [noisy_scene(index, route=index % 2 == 1) for index in range(4)]
# The same pictures, seen while the car moves otherwise and with tracked objects around.
SCENES += [
    replace(scene, history=other.history, tracks=tracks)
    for scene, other, tracks in zip(SCENES[:2], SCENES[2:], ((), made_up_tracks(5)), strict=True)
]


@dataclass(frozen=True)
class Arrival:
    """A request, the step it arrives at, and the step it is cancelled at, if it is."""

    request: PlanRequest
    step: int
    cancelled: int | None


@dataclass(frozen=True)
class Mix:
    """Requests, and the decoder that serves them."""

    arrivals: list[Arrival]
    shortcuts: Shortcuts
    rows: int
    chunk: int
    usual_tokens: int
    reproducible: bool


@st.composite
def arrivals(draw: st.DrawFn) -> list[Arrival]:
    found = []
    for index in range(draw(st.integers(1, 4))):
        format = draw(st.sampled_from(["cf_vla"] * len(NAMES) + list(NAMES)))
        family = family_named(format)
        scene = draw(st.sampled_from(SCENES))
        thinking: Thinking = draw(st.sampled_from(["adaptive", *family.thinking_choices]))
        thresholds = [None, 0.3, 0.6] if family.branch is not None and thinking == "adaptive" else [None]
        prefill = None
        if format == "cf_vla" and draw(st.integers(0, 3)) == 0:
            bins = np.zeros((3, 64), np.int8)
            bins[0, draw(st.integers(1, 63)) :] = 1
            prefill = plan_from_bins(bins)
        controls = Controls(
            n=draw(st.integers(1, 5)),
            thinking=thinking,
            think_threshold=draw(st.sampled_from(thresholds)),
            prefill=prefill,
            temperature=draw(st.sampled_from([0.0, 0.2, 0.7, 1.0, 1.5])),
            top_p=draw(st.sampled_from([1.0, 0.9, 0.5])),
            seed=draw(st.integers(0, 1000)),
            numbers=draw(st.sampled_from(["least_error", "drawn"])),
            codes=draw(st.sampled_from(["least_error", "drawn"])),
            # The clock stands still: deadlines only decide who gives way to whom, and make drafts.
            deadline_ms=draw(st.sampled_from([None, None, 2_000, 3_000])),
        )
        if family.imagination is not None and draw(st.booleans()):
            # Where the scene shows the camera, its picture half a second later is guessed.
            camera = draw(st.sampled_from([*(clip.camera for clip in scene.clips), *CAMERAS]))
            once = draw(st.booleans())
            controls = replace(controls, imagine="always", camera=camera, imagine_once=once)
        attempt = None
        if family.refines:
            draft = np.zeros((len(family.times_s), 4), np.float32)
            attempt = Attempt(draft, draw(st.sampled_from(["Brake.", "It leaves the road on the left."])))
        found.append(
            Arrival(
                PlanRequest(f"r{index}", scene, format, controls, attempt),
                step=draw(st.integers(0, 30)),
                cancelled=draw(st.one_of(st.none(), st.none(), st.integers(1, 60))),
            )
        )
    return found


mixes = st.builds(
    Mix,
    arrivals(),
    st.builds(Shortcuts, **{field.name: st.booleans() for field in fields(Shortcuts)}),
    st.integers(10, 20),
    st.sampled_from([7, 64, 256]),
    # Some KV rows have room for what responses usually take, and some are outgrown all the time.
    st.sampled_from([0, 16, 128]),
    st.booleans(),
)


Families = Mapping[str, Family]


def with_format(format: Format) -> Families:
    """One that writes ``format`` in the place of `cf_vla`."""
    revised = CF_VLA.revised_plan if CF_VLA.revised_plan in format.sections() else None
    changed = replace(CF_VLA, format=format, revised_plan=revised)
    return {**families_of(NAMES, "free_text"), "cf_vla": changed}


made_up: st.SearchStrategy[Families] = st.one_of(
    st.just("free_text").map(partial(families_of, NAMES)),
    st.just("phrases").map(partial(families_of, NAMES)),
    branching_formats().map(with_format),
)
"""Those that there are, or one with a format that nobody thought of."""


@pytest.fixture(scope="module", params=["every vision token", "resampled"])
def exact(
    request: pytest.FixtureRequest, toy_family: None, tmp_path_factory: pytest.TempPathFactory
) -> Loaded:
    resampled = replace(NANO_SETTINGS, fine_vision=True)
    settings = resampled if request.param == "resampled" else VlaSettings()
    settings = replace(settings, formats=NAMES, reflection="phrases")
    folder = CHECKPOINT or write_untrained(
        tmp_path_factory.mktemp("narrow") / "untrained", narrow=True, settings=settings
    )
    loaded = exactly(load(Path(folder), dtype=torch.float64))
    if CHECKPOINT:
        return loaded
    torch.manual_seed(0)
    copy_picture_codes(loaded)
    return with_visual_codes(loaded, VisualCodes(24).eval())


@pytest.fixture(scope="module", autouse=True)
def _inference() -> Iterator[None]:
    with torch.inference_mode():
        yield


def decode(decoder: Decoder, mix: list[Arrival]) -> dict[tuple[str, int], Draw]:
    """Whatever finishes, requests arriving and leaving in their steps."""
    draws: dict[tuple[str, int], Draw] = {}
    waiting, step = list(mix), 0
    while waiting or not decoder.idle:
        for arrival in [each for each in waiting if each.step <= step]:
            decoder.add(arrival.request)
            waiting.remove(arrival)
        for arrival in mix:
            if arrival.cancelled == step:
                decoder.cancel(arrival.request.request_id)
        for name, event in decoder.step():
            assert not isinstance(event, Failed), event
            if isinstance(event, DrawFinished):
                draws[name, event.draw.index] = event.draw
        check_integrity(decoder)
        step += 1
    return draws


@contextmanager
def noted() -> Iterator[Mapping[tuple[str, int], Shares]]:
    """What each draw (request, index) has to choose from meanwhile."""
    shares: dict[tuple[str, int], Shares] = defaultdict(dict)
    choices = Row.choices

    def noting(row: Row, logits: npt.NDArray[np.float64], time_for: TimeFor) -> object:
        if not row.draft:
            for draw in row.draws:
                shares[row.request.id, draw][len(row.tokens)] = probabilities(logits)
        return choices(row, logits, time_for)

    with patch.object(Row, "choices", noting):
        yield shares


compared = 0


def plainly(exact: Loaded, requests: list[PlanRequest], families: Families) -> dict[tuple[str, int], Draw]:
    """What the decoder without shortcuts writes for requests that arrive together and stay."""
    rows = sum(2 * request.controls.n for request in requests)
    runner = Runner(exact, rows, prompts=rows // 2, reuse=False, families=families)
    decoder = Decoder(runner, Shortcuts.none(), clock=lambda: 0.0)
    return decode(decoder, [Arrival(request, 0, None) for request in requests])


def named(mix: int, request: PlanRequest) -> PlanRequest:
    return replace(request, request_id=f"{mix}.{request.request_id}")


@seed(SEED)
@settings(
    max_examples=-(-MIXES // TOGETHER),
    deadline=None,
    derandomize=True,
    suppress_health_check=list(HealthCheck),
    database=None,
)
@given(together=st.lists(mixes, min_size=TOGETHER, max_size=TOGETHER), made_up=made_up)
def test_nothing_that_makes_it_fast_changes_a_response(
    exact: Loaded, together: list[Mix], made_up: Families
) -> None:
    global compared
    requests = [named(number, each.request) for number, mix in enumerate(together) for each in mix.arrivals]
    with noted() as plain_shares:
        plain = plainly(exact, requests, made_up)
    for number, mix in enumerate(together):
        runner = Runner(
            exact,
            mix.rows,
            clip_bytes=1 << 20,
            reproducible=mix.reproducible,
            reuse=mix.shortcuts.reuse,
            capture=Again if mix.shortcuts.capture else None,
            families=made_up,
            usual_tokens=mix.usual_tokens,
        )
        decoder = Decoder(runner, mix.shortcuts, prompt_chunk=mix.chunk, clock=lambda: 0.0)
        with noted() as shares:
            fast = decode(decoder, mix.arrivals)
        assert {each.request.request_id for each in mix.arrivals if each.cancelled is None} <= {
            name for name, _ in fast
        }
        for (name, index), draw in fast.items():
            same(draw, plain[f"{number}.{name}", index])
            same_shares(shares[name, index], plain_shares[f"{number}.{name}", index])
        compared += len(fast)
    if MIXES > 100:
        print(f"{compared} responses compared, no difference", flush=True)


@seed(SEED)
@settings(
    max_examples=max(2, MIXES // 20),
    deadline=None,
    derandomize=True,
    suppress_health_check=list(HealthCheck),
    database=None,
)
@given(mix=arrivals(), made_up=made_up)
def test_the_decoder_without_shortcuts_is_the_one_of_transformers(
    exact: Loaded, mix: list[Arrival], made_up: Families
) -> None:
    with noted() as shares:
        draws = plainly(exact, [each.request for each in mix], made_up)
    for expected, expected_shares in reference(exact, mix[0].request, made_up):
        key = mix[0].request.request_id, expected.index
        same(draws[key], expected)
        same_shares(shares[key], expected_shares)


def same(draw: Draw, other: Draw) -> None:
    """Every token and the branch; the think probability within rounding."""
    assert draw.text == other.text
    assert draw.tokens == other.tokens
    assert draw.branch == other.branch
    if other.think_probability is not None:
        assert draw.think_probability == pytest.approx(other.think_probability, rel=1e-9)


def same_shares(shares: Shares, others: Shares) -> None:
    """The same decisions, between tokens as likely within rounding."""
    assert shares.keys() == others.keys()
    for position, found in shares.items():
        np.testing.assert_allclose(found, others[position], rtol=1e-9)


def resident_bytes() -> int:
    """Of this process, garbage left out."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_a_soak_leaves_nothing_behind(exact: Loaded) -> None:
    """Requests come, end and are cancelled by chance; all others end, everything is free, memory is flat."""
    random = np.random.default_rng(0)
    decoder = Decoder(Runner(exact, 12, clip_bytes=1 << 20), prompt_chunk=64)
    names: list[str] = []
    steps = int(os.environ.get("LOOKTWICE_SOAK_STEPS", "300"))
    halfway = 0
    for step in range(steps):
        if random.random() < 0.2:
            names.append(f"s{step}")
            format = "traj_only" if random.random() < 0.6 else "cf_vla"
            deadline_ms = None if random.random() < 0.5 else int(random.integers(0, 2000))
            controls = Controls(n=int(random.integers(1, 7)), seed=step, deadline_ms=deadline_ms)
            if format == "cf_vla":
                controls = replace(controls, **VARIATIONS[step % len(VARIATIONS)])
            decoder.add(PlanRequest(names[-1], SCENES[step % 4], format, controls))
        if names and random.random() < 0.03:
            decoder.cancel(names[int(random.integers(len(names)))])
        for _, event in decoder.step():
            assert not isinstance(event, Failed), event
        check_integrity(decoder)
        if step == steps // 2:
            halfway = resident_bytes()
    assert resident_bytes() < 1.1 * halfway, "memory grows"
    print(
        f"{len(names)} requests, {halfway / 1e9:.2f} GB halfway, {resident_bytes() / 1e9:.2f} GB at the end"
    )
    for _ in range(2000):
        decoder.step()
        check_integrity(decoder)
    assert decoder.idle, "a request is stuck"
    assert decoder.rows_used == 0
    gc.collect()
    left = [each for each in gc.get_objects() if type(each) in (Row, Request, PromptPrefill)]
    assert not left, "kept for nobody"
