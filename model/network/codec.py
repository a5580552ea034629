"""The trajectory codec: [64, 4] poses as 6 codes and back.

What is quantised is the way a trajectory leaves constant velocity: x - v0 t, y and heading, written in cubic
splines whose value (and for x and y slope) at the present is zero. So every decodable trajectory starts
where the ego is, at the speed it has: there is no jump between the present pose and +0.1 s.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from looktwice.model.driving.scene import EGO_LENGTH_M
from looktwice.model.driving.trajectory import FUTURE_STEPS, HORIZON_S, STEP_S, FloatArray
from looktwice.model.driving.whole_files import written_whole
from looktwice.model.network import quantiser
from looktwice.model.network.splines import clamped_basis

CODEC_FILE: Final = "trajectory_codec.safetensors"
CODEC_VERSION: Final = 1

_KNOTS_S: Final = np.array([0.0, 0.4, 0.8, 1.3, 1.9, 2.6, 3.4, 4.3, 5.3, HORIZON_S])
"""Closer near the present, where a curve must leave a fixed slope; evenly enough after."""
HEADING_WEIGHT_M: Final = EGO_LENGTH_M / 3
"""Metres that a radian of heading counts. It moves a corner of the ego's box by half its length; a third
costs 0.1 degrees of heading on MetaDrive scenes and wins a tenth of the displacement error."""
DIMENSIONS: Final = 20
"""Of the space that trajectories are quantised in, where there are examples enough to fit them."""
CURVE_VALUES: Final = 3 * FUTURE_STEPS
"""Of the curves of x, y and heading."""
_MAX_FIT_VECTORS: Final = 80_000
_REFINEMENTS: Final = 3
_TIMES_S: Final = STEP_S * np.arange(1, FUTURE_STEPS + 1, dtype=np.float64)


class CodecError(ValueError):
    """A codec file or codes that cannot be used; the text says why."""


@dataclass(frozen=True, eq=False)
class TrajectoryCodec:
    """6 codes for a trajectory, given the ego history.

    Attributes:
        mean: float32 [192] mean of the weighted curves of x, y and heading, 64 values each.
        axes: float32 [d, 192] orthonormal directions in which they differ most. All lie within the
            spline space; lengths are root mean square metres over the horizon times 8.
        books: float32 [6, K, d] codebooks of the residual quantisation.
    """

    mean: FloatArray
    axes: FloatArray
    books: FloatArray

    @property
    def size(self) -> int:
        """Codes per stage."""
        return int(self.books.shape[1])

    @classmethod
    def fit(
        cls,
        histories: npt.NDArray[np.floating],
        futures: npt.NDArray[np.floating],
        codes: int = 6,
        size: int = 512,
        seed: int = 0,
    ) -> TrajectoryCodec:
        """A codec learned from histories [n, 16, 4] and futures [n, 64, 4] and their mirror images.

        At most 80,000 curves are used, chosen by ``seed``.
        """
        curves = _curves(np.asarray(histories, np.float64), np.asarray(futures, np.float64))
        mirror = np.repeat([1.0, -1.0, -1.0], FUTURE_STEPS)
        curves = np.concatenate([curves, curves * mirror])
        if len(curves) > _MAX_FIT_VECTORS:
            curves = curves[np.random.default_rng(seed).permutation(len(curves))[:_MAX_FIT_VECTORS]]
        space = _spline_space()
        in_space = curves @ space
        mean = in_space.mean(axis=0)
        _, _, directions = np.linalg.svd(in_space - mean, full_matrices=False)
        kept = directions[:DIMENSIONS]
        vectors = ((in_space - mean) @ kept.T).astype(np.float32)
        books = quantiser.fit_codebooks(vectors, codes, size, rounds=_REFINEMENTS, seed=seed)
        return cls((space @ mean).astype(np.float32), (kept @ space.T).astype(np.float32), books)

    def encode(
        self, histories: npt.NDArray[np.floating], futures: npt.NDArray[np.floating]
    ) -> npt.NDArray[np.int64]:
        """Codes int64 [n, 6], each 0..K-1, of futures [n, 64, 4] with histories [n, 16, 4]."""
        return quantiser.encode(self.vectors(histories, futures), self.books)

    def vectors(self, histories: npt.NDArray[np.floating], futures: npt.NDArray[np.floating]) -> FloatArray:
        """What is quantised, float32 [n, d]; a sum of one codeword per stage approximates it."""
        curves = _curves(np.asarray(histories, np.float64), np.asarray(futures, np.float64))
        vectors: FloatArray = ((curves - self.mean) @ self.axes.T).astype(np.float32)
        return vectors

    def decode(
        self,
        histories: npt.NDArray[np.floating],
        codes: npt.NDArray[np.integer] | Sequence[Sequence[int]],
    ) -> FloatArray:
        """Trajectories float32 [n, 64, 4] with z = 0; raises `CodecError` for codes out of range."""
        chosen = np.asarray(codes, np.int64).reshape(-1, len(self.books))
        if chosen.size and not 0 <= chosen.min() <= chosen.max() < self.size:
            raise CodecError(f"codes must lie in 0..{self.size - 1}")
        return self.trajectories(histories, quantiser.decode(chosen, self.books))

    def first_trajectories(self, history: npt.NDArray[np.floating]) -> FloatArray:
        """float32 [K, 64, 4]: what each first code alone stands for behind one history [16, 4]."""
        return self.trajectories(np.asarray(history)[None], self.books[0])

    def trajectories(self, histories: npt.NDArray[np.floating], vectors: FloatArray) -> FloatArray:
        """Trajectories float32 [n, 64, 4] with z = 0 of vectors [n, d], as `vectors` gives them."""
        curves = (vectors @ self.axes + self.mean).reshape(-1, 3, FUTURE_STEPS)
        trajectories = np.zeros((len(curves), FUTURE_STEPS, 4), np.float32)
        trajectories[..., 0] = curves[:, 0] + _present_speeds(histories)[:, None] * _TIMES_S
        trajectories[..., 1] = curves[:, 1]
        trajectories[..., 3] = curves[:, 2] / HEADING_WEIGHT_M
        return trajectories

    def code_distances_m(self) -> FloatArray:
        """float32 [6, K, K]: how far two codes of a stage leave trajectories apart, in metres.

        Root mean square over the horizon of x, y and weighted heading.
        """
        vectors = self.code_vectors()
        return np.stack([np.linalg.norm(each[:, None] - each, axis=-1) for each in vectors])

    def code_vectors(self) -> FloatArray:
        """float32 [6, K, d]: what each code adds, in metres of root mean square over the horizon."""
        return self.books / np.float32(np.sqrt(FUTURE_STEPS))

    def reconstruction_error(
        self, histories: npt.NDArray[np.floating], futures: npt.NDArray[np.floating]
    ) -> dict[str, float]:
        """How far decoded trajectories lie from the given ones, in metres.

        ``max_jump_m`` is the largest distance of the first decoded pose from where the present speed leads.
        """
        decoded = self.decode(histories, self.encode(histories, futures))
        apart = np.linalg.norm(decoded[..., :2] - np.asarray(futures)[..., :2], axis=-1)
        expected_x = _present_speeds(histories) * STEP_S
        jump = np.hypot(decoded[:, 0, 0] - expected_x, decoded[:, 0, 1])
        return {
            "ade_m": float(apart.mean()),
            "fde_m": float(apart[:, -1].mean()),
            "ade_p95_m": float(np.quantile(apart.mean(axis=1), 0.95)),
            "max_jump_m": float(jump.max()),
        }

    def save(self, folder: Path) -> None:
        """Write ``trajectory_codec.safetensors`` into ``folder``."""
        tensors = {name: np.ascontiguousarray(getattr(self, name)) for name in ("mean", "axes", "books")}
        about = {"version": CODEC_VERSION, "kind": "spline residual vector quantisation"}
        with written_whole(folder / CODEC_FILE) as temporary:
            save_file(tensors, temporary, metadata={"looktwice": json.dumps(about)})

    @classmethod
    def load(cls, folder: Path) -> TrajectoryCodec:
        """Read what `save` wrote; raises `CodecError` when it is missing, damaged or of another version."""
        path = folder / CODEC_FILE
        if not path.is_file():
            raise CodecError(f"{folder} has no {CODEC_FILE}")
        try:
            with safe_open(path, framework="numpy") as file:
                about: dict[str, Any] = json.loads((file.metadata() or {}).get("looktwice", "{}"))
                if about.get("version") != CODEC_VERSION:
                    found = about.get("version")
                    raise CodecError(f"{path} has version {found}; this LookTwice reads {CODEC_VERSION}")
                return cls(*(file.get_tensor(name) for name in ("mean", "axes", "books")))
        except (SafetensorError, json.JSONDecodeError) as error:
            raise CodecError(f"{path} is damaged: {error}") from error


def _present_speeds(histories: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """`looktwice.model.driving.trajectory.present_speed` of histories [n, 16, 4] at once, m/s [n]."""
    speeds: npt.NDArray[np.float64] = -np.asarray(histories, np.float64)[:, -4, 0] / (3 * STEP_S)
    return speeds


def _curves(histories: npt.NDArray[np.float64], futures: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """[n, 192]: x - v0 t, y and weighted heading, unwrapped from the present heading on."""
    heading = np.unwrap(futures[..., 3], axis=1)
    heading -= 2 * np.pi * np.round(heading[:, :1] / (2 * np.pi))
    x = futures[..., 0] - _present_speeds(histories)[:, None] * _TIMES_S
    return np.concatenate([x, futures[..., 1], heading * HEADING_WEIGHT_M], axis=1)


def _spline_space() -> npt.NDArray[np.float64]:
    """Orthonormal directions [192, s] of all curves that splines with a fixed beginning can draw."""
    basis = clamped_basis(_TIMES_S, _KNOTS_S)
    position, _ = np.linalg.qr(basis[:, 2:])
    # A turning ego has a yaw rate at once: only the heading's value is fixed.
    heading, _ = np.linalg.qr(basis[:, 1:])
    space = np.zeros((3 * FUTURE_STEPS, 2 * position.shape[1] + heading.shape[1]))
    at = 0
    for row, block in enumerate((position, position, heading)):
        space[row * FUTURE_STEPS : (row + 1) * FUTURE_STEPS, at : at + block.shape[1]] = block
        at += block.shape[1]
    return space
