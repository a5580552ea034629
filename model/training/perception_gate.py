"""What reading pictures is worth to a plan: one small planner on facts that were read, on true ones, on none.

A decoder learns slowly; a small planner shows in minutes whether what is read from pictures is good enough to
plan by. It learns on scenes of one set and is measured on another; reading both with the same checkpoint, on
scenes that it was grounded on, can only make the read facts look worse: they are better there than elsewhere.
"""

from __future__ import annotations

from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt
import torch

from looktwice.model.driving.intervals import ratio_interval
from looktwice.model.driving.tracks import MAX_TRACKS
from looktwice.model.evaluation.perception import FactReadings
from looktwice.model.network.codec import TrajectoryCodec
from looktwice.model.network.fact_reader import weighed
from looktwice.model.network.small_planner import SmallInputs, SmallKind
from looktwice.model.network.track_features import TRACK_FEATURES
from looktwice.model.training.small import SmallExamples, SmallSettings, fit_small, small_errors

Gate = Literal["none", "read", "true"]
GATES: Final[tuple[Gate, ...]] = ("none", "read", "true")


def perception_gate(
    learned_on: FactReadings, measured_on: FactReadings, codec: TrajectoryCodec, settings: SmallSettings
) -> list[dict[str, Any]]:
    """A row for each of `GATES`: ``facts``, ``ade_m``, ``against_none`` (metres), and intervals."""
    errors: dict[Gate, npt.NDArray[np.float64]] = {}
    for gate in GATES:
        kind: SmallKind = "blind" if gate == "none" else "facts"
        planner = fit_small(kind, _examples(learned_on, gate), codec, settings)
        errors[gate] = small_errors(planner, _examples(measured_on, gate)).numpy().astype(np.float64)
    rows: list[dict[str, Any]] = []
    for name, found in errors.items():
        row: dict[str, Any] = {"facts": name, "ade_m": float(found.mean())}
        row["interval"] = _mean_interval(found, measured_on.episodes)
        row["against_none"] = float((found - errors["none"]).mean())
        row["against_none_interval"] = _mean_interval(found - errors["none"], measured_on.episodes)
        rows.append(row)
    return rows


def format_gate(rows: list[dict[str, Any]]) -> str:
    """The rows as plain text."""
    lines = ["small planner given", f"  {'facts':8} {'ADE, m':>7}  {'95 %':14} {'to none':>8}  95 %"]
    for row in rows:
        interval = "{:.2f} to {:.2f}".format(*row["interval"])
        apart = "{:.2f} to {:.2f}".format(*row["against_none_interval"])
        lines.append(
            f"  {row['facts']:8} {row['ade_m']:7.2f}  {interval:14} {row['against_none']:+8.2f}  {apart}"
        )
    return "\n".join(lines)


def _examples(reading: FactReadings, gate: Gate) -> SmallExamples:
    nobody = torch.zeros(len(reading.read), MAX_TRACKS, len(TRACK_FEATURES))
    facts = None if gate == "none" else weighed(torch.from_numpy(getattr(reading, gate)))
    inputs = SmallInputs(torch.from_numpy(reading.history), torch.from_numpy(reading.route), nobody, facts)
    return SmallExamples(inputs, torch.from_numpy(reading.future), torch.from_numpy(reading.episodes))


def _mean_interval(values: npt.NDArray[np.float64], episodes: npt.NDArray[np.int64]) -> tuple[float, float]:
    _, place = np.unique(episodes, return_inverse=True)
    sums, counts = np.bincount(place, values), np.bincount(place)
    return ratio_interval(sums.astype(np.float64), counts.astype(np.float64))
