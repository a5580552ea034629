"""Residual vector quantisation: a vector as the sum of one codeword out of each stage's codebook."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]

BEAM: Final = 12
"""Candidates kept from stage to stage when encoding; beyond it errors hardly shrink."""
_CHUNK: Final = 2048
_KMEANS_ROUNDS: Final = 15
_RIDGE: Final = 3.0
"""In samples: how strongly a codeword stays where it is when few vectors use it."""


def fit_codebooks(vectors: FloatArray, stages: int, size: int, *, rounds: int, seed: int) -> FloatArray:
    """Codebooks [stages, size, d] for vectors [n, d].

    k-means on what the stages before leave, then ``rounds`` of joint refinement: encode by beam search,
    then solve for all codewords at once by least squares.
    """
    random = np.random.default_rng(seed)
    books = np.zeros((stages, size, vectors.shape[1]), np.float32)
    rest = vectors.copy()
    for stage in range(stages):
        books[stage] = _kmeans(rest, size, random)
        rest -= books[stage][_nearest(rest, books[stage])]
    for _ in range(rounds):
        codes = encode(vectors, books)
        _revive(books, codes, vectors, random)
        books = _refit(vectors, codes, books)
    return books


def encode(vectors: FloatArray, books: FloatArray, beam: int = BEAM) -> IntArray:
    """Codes int64 [n, stages] whose codewords' sum comes close to vectors [n, d], by beam search."""
    parts = [_encode_chunk(vectors[at : at + _CHUNK], books, beam) for at in range(0, len(vectors), _CHUNK)]
    return np.concatenate(parts) if parts else np.zeros((0, len(books)), np.int64)


def decode(codes: npt.NDArray[np.integer], books: FloatArray) -> FloatArray:
    """Vectors [n, d]: the sums of the codewords."""
    total: FloatArray = books[np.arange(len(books)), codes].sum(axis=1)
    return total


def _encode_chunk(vectors: FloatArray, books: FloatArray, beam: int) -> IntArray:
    count, size = len(vectors), books.shape[1]
    rows = np.arange(count)[:, None]
    rest = vectors[:, None]
    codes = np.zeros((count, 1, 0), np.int64)
    for book in books:
        # |rest - word|^2 without the last stages' common part would do, but beams differ in |rest|.
        cost = (book**2).sum(axis=1) - 2 * (rest @ book.T)
        cost += (rest**2).sum(axis=2, keepdims=True)
        flat = cost.reshape(count, -1)
        keep = min(beam, flat.shape[1])
        best = (
            np.argpartition(flat, keep - 1, axis=1)[:, :keep]
            if keep < flat.shape[1]
            else rows * 0 + np.arange(keep)
        )
        from_beam, word = best // size, best % size
        rest = rest[rows, from_beam] - book[word]
        codes = np.concatenate([codes[rows, from_beam], word[..., None]], axis=2)
    winner = (rest**2).sum(axis=2).argmin(axis=1)
    result: IntArray = codes[np.arange(count), winner]
    return result


def _nearest(vectors: FloatArray, words: FloatArray) -> IntArray:
    nearest = np.empty(len(vectors), np.int64)
    squares = (words**2).sum(axis=1)
    for at in range(0, len(vectors), 4 * _CHUNK):
        part = vectors[at : at + 4 * _CHUNK]
        nearest[at : at + len(part)] = (squares - 2 * (part @ words.T)).argmin(axis=1)
    return nearest


def _kmeans(vectors: FloatArray, size: int, random: np.random.Generator) -> FloatArray:
    words = vectors[random.choice(len(vectors), size, replace=len(vectors) < size)].copy()
    for _ in range(_KMEANS_ROUNDS):
        nearest = _nearest(vectors, words)
        counts = np.bincount(nearest, minlength=size)
        sums = np.stack([np.bincount(nearest, column, minlength=size) for column in vectors.T], axis=1)
        words = (sums / np.maximum(counts, 1)[:, None]).astype(np.float32)
        empty = counts == 0
        words[empty] = vectors[random.integers(len(vectors), size=int(empty.sum()))]
    return words


def _revive(books: FloatArray, codes: IntArray, vectors: FloatArray, random: np.random.Generator) -> None:
    """Move codewords that nothing uses to what is left of the vectors that are met worst."""
    rest = vectors - decode(codes, books)
    worst = np.argsort(-(rest**2).sum(axis=1))[: max(1, len(rest) // 20)]
    for stage, book in enumerate(books):
        unused = np.flatnonzero(np.bincount(codes[:, stage], minlength=len(book)) == 0)
        chosen = random.choice(worst, len(unused))
        book[unused] = rest[chosen] + book[codes[chosen, stage]]


def _refit(vectors: FloatArray, codes: IntArray, books: FloatArray) -> FloatArray:
    """All codewords that minimise the squared error for these codes (ridge towards where they are)."""
    stages, size, dims = books.shape
    columns = codes + np.arange(stages) * size
    total = stages * size
    normal = np.zeros((total, total))
    for one in range(stages):
        for other in range(stages):
            pair = np.bincount(codes[:, one] * size + codes[:, other], minlength=size * size)
            normal[one * size : (one + 1) * size, other * size : (other + 1) * size] = pair.reshape(
                size, size
            )
    flat = books.reshape(total, dims).astype(np.float64)
    right = np.stack(
        [np.bincount(columns.ravel(), np.repeat(column, stages), minlength=total) for column in vectors.T],
        axis=1,
    )
    normal[np.diag_indices(total)] += _RIDGE
    solved = np.linalg.solve(normal, right + _RIDGE * flat)
    return solved.reshape(books.shape).astype(np.float32)
