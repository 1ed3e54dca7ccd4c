"""Cycle length of a sensor, and whether its raw frames determine a phase at each frequency."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ..constants import CANONICAL_SHIFTS, FRAMES_PER_QUARTET

QUADS_MIN = 3  # of a phasor: cosine, sine and a constant
SAME_RAD = 1e-5  # [rad] shifts are stored as float32 at worst
# singular values of three unknowns are about 1; two shifts closer than 0.1 degrees are one
RANK_TOLERANCE = 1e-3


def find_cycle(shifts: Float[np.ndarray, "F"], frequencies: Float[np.ndarray, "F"]) -> int:
    """Number of raw frames in a cycle, for a recording that does not state it.

    The shortest period of shifts [rad] and frequencies [Hz] that determines a phase at each of them
    and either occurs twice or repeats no raw frame. Without a period it is the whole recording, if
    that is one cycle: several frequencies, or no repeated shift. Else four raw frames in any order,
    of which a recording may have fewer.
    """
    count = len(shifts)
    waves = np.exp(1j * np.asarray(shifts, dtype=np.float64))
    for step in range(QUADS_MIN, count):
        again = np.abs(waves[step:] - waves[:-step]).max() < SAME_RAD
        if again and np.array_equal(frequencies[step:], frequencies[:-step]):
            sure = 2 * step <= count or _distinct(waves[:step], frequencies[:step])
            if sure and determined(shifts[:step], frequencies[:step]):
                return step
    if len(set(frequencies.tolist())) > 1:
        return count
    canonical = np.exp(1j * np.asarray(CANONICAL_SHIFTS))
    begun = count < FRAMES_PER_QUARTET and bool(
        (np.abs(waves[:, None] - canonical).min(axis=1) < SAME_RAD).all()
    )
    whole = not begun and _distinct(waves, frequencies) and determined(shifts, frequencies)
    return count if whole else FRAMES_PER_QUARTET


def _distinct(waves: np.ndarray, frequencies: np.ndarray) -> bool:
    """Whether no two raw frames have the same shift and frequency."""
    same = (np.abs(waves[:, None] - waves) < SAME_RAD) & (frequencies[:, None] == frequencies)
    return int(same.sum()) == len(waves)


def frequencies_by_order(frequencies: Float[np.ndarray, "F"]) -> tuple[float, ...]:
    """Each frequency once, in the order of first appearance."""
    return tuple(dict.fromkeys(frequencies.tolist()))


def frequencies_decoded(frequencies: Float[np.ndarray, "K"], wanted: tuple[float, ...]) -> bool:
    """Whether these frequencies are the wanted ones, each three times or more."""
    distinct, counts = np.unique(frequencies, return_counts=True)
    return set(distinct.tolist()) == set(wanted) and int(counts.min()) >= QUADS_MIN


def solution(shifts: Float[np.ndarray, "Q"]) -> Float[np.ndarray, "2 Q"] | None:
    """Least-squares matrix from quads of these shifts [rad] to (re, im); None if singular."""
    model = np.stack([np.cos(shifts), np.sin(shifts), np.ones(len(shifts))], axis=1)
    if len(shifts) < QUADS_MIN or np.linalg.svd(model, compute_uv=False).min() < RANK_TOLERANCE:
        return None
    return 2.0 * np.linalg.pinv(model)[:2]


def phase_noise(shifts: Float[np.ndarray, "Q"]) -> float:
    """Noise of a decoded phase [rad] times amplitude over noise of a quad, RMS over phases.

    It is sqrt(2 / Q) if the shifts are equally spaced.

    Raises:
        ValueError: If the shifts determine no phase.
    """
    rows = solution(np.asarray(shifts, dtype=np.float64))
    if rows is None:
        raise ValueError(
            f"shifts: a phase needs three different ones, got {np.degrees(shifts).tolist()} degrees"
        )
    return 0.5 * float(np.sqrt(0.5 * np.sum(rows**2)))


def determined(shifts: np.ndarray, frequencies: np.ndarray) -> bool:
    """Whether the shifts at each frequency determine a phase."""
    return all(solution(shifts[frequencies == f]) is not None for f in set(frequencies.tolist()))
