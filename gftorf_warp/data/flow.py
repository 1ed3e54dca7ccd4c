"""Optical flow between raw frames of one shift, a cycle apart, for recordings without flow.

Frames n and n + K have the same shift and frequency, K being the raw frames of a cycle, so a moving
surface has nearly the same contrast in both. The flow of quartet start n is the median over the
pairs n + j that start at most half a cycle away: pair n + j shows the surface a little earlier or
later, at x + s F(x), s being its time from n in units of the pair's length. Pairs of different
shifts have their weak contrast at different distances, and their noise is independent.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from .sequence import Flow, Sequence
from .threads import KeptThreads

Method = Literal["dis", "deepflow"]

# of a cycle: pairs that start farther from n have another motion where paths are curved
APART_MAX = 0.5
# [px] of forward and backward flow; occluded pixels disagree by the motion itself
CONSISTENCY_PX = 1.0
BLUR_PX = 0.7  # [px] before matching: halves the noise, keeps edges
SMALLEST_PX = 12  # [px] the matcher refuses smaller images
# [%] of pixels at either end that may saturate, so that one hot pixel does not set the scale
ROBUST_PERCENT = 0.05


def compute_flow(sequence: Sequence, *, method: Method = "dis", every: int | None = None) -> Flow:
    """Compute the optical flow of every quartet start whose partner a cycle away was measured too,
    or of one in ``every`` raw frames.

    Flow is float32, and NaN where forward and backward flow disagree in most pairs. Stored flow is
    ignored. ``dis`` is fast and follows large motion; ``deepflow`` is smoother where motion stays
    below about two pixels in a cycle, and loses what moves farther.

    Raises:
        InputError: If the images are too small to match.
        ValueError: If the method has another name.
    """
    if method not in ("dis", "deepflow"):
        raise ValueError(f"method must be dis or deepflow, got {method!r}")
    check_size(sequence)
    step, times, quads = sequence.cycle, sequence.times, sequence.quads
    pairs = np.flatnonzero(sequence.measured[:-step] & sequence.measured[step:]).tolist()

    def matched(n: int) -> tuple[np.ndarray, ...]:
        """Flow from n to n + K and back; each again, with NaN where they disagree."""
        match = _matcher(method)  # holds buffers: one for each call
        first, second = _grey(quads[n], quads[n + step])
        there, back = match(first, second), match(second, first)
        return there, back, _consistent(there, back), _consistent(back, there)

    # OpenCV releases Python's lock
    with KeptThreads("gftorf-flow") as threads:
        by_pair = dict(zip(pairs, threads.map(matched, pairs), strict=True))

        def combined(k: int, first: int, step: int) -> dict[int, np.ndarray]:
            raw, reliable = (
                {n + first: flows[i] for n, flows in by_pair.items()} for i in (k, k + 2)
            )
            starts = [n for n in range(0, sequence.frames, every or sequence.cycle) if n in raw]
            flows = threads.map(lambda n: median_flow(n, raw, reliable, times, step), starts)
            return dict(zip(starts, flows, strict=True))

        return Flow(forward=combined(0, 0, step), backward=combined(1, step, -step))


def flow_between(
    first: Float[np.ndarray, "H W"], second: Float[np.ndarray, "H W"], *, method: Method = "dis"
) -> Float[np.ndarray, "2 H W"]:
    """Optical flow [px] from an image to another one of the same brightness; NaN where the flow
    back disagrees.
    """
    match = _matcher(method)
    grey = _grey(first, second)
    return _consistent(match(*grey), match(*grey[::-1]))


def check_size(sequence: Sequence) -> None:
    """Refuse images that cannot be matched.

    Raises:
        InputError: If they are too small.
    """
    if min(sequence.height, sequence.width) < SMALLEST_PX:
        size, where = f"{sequence.width}x{sequence.height}", sequence.path or "sequence"
        why = f"expected at least {SMALLEST_PX}x{SMALLEST_PX} pixels, found {size}"
        fix = "provide flow as files, or use larger images"
        raise InputError("images too small for optical flow", where=where, why=why, fix=fix)


def brightness_range(*images: Float[np.ndarray, "H W"]) -> tuple[float, float]:
    """Smallest and largest value of images, single hot pixels aside."""
    low, high = np.percentile(np.stack(images), [ROBUST_PERCENT, 100.0 - ROBUST_PERCENT])
    return float(low), float(high)


def warp_back(
    image: Float[np.ndarray, "H W"], flow: Float[np.ndarray, "2 H W"]
) -> Float[np.ndarray, "H W"]:
    """A later frame brought back to the earlier one: its value at x + flow(x), bilinear."""
    return sample(image[None], flow)[0]


def _matcher(method: Method) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Function from two uint8 images to the flow [2, H, W] from the first to the second."""
    import cv2

    engine: Any  # OpenCV's stubs do not know that the flow to start from may be None
    if method == "dis":
        engine = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        engine.setFinestScale(0)  # the preset stops at half resolution; raw frames are small
        engine.setVariationalRefinementIterations(20)
    else:
        engine = cv2.optflow.createOptFlow_DeepFlow()

    def match(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(engine.calc(first, second, None).transpose(2, 0, 1))

    return match


def _grey(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two quads [H, W] as uint8 images with one scale for both."""
    import cv2

    low, high = brightness_range(first, second)
    scale = 255.0 / (high - low) if high > low else 0.0

    def grey(quad: np.ndarray) -> np.ndarray:
        scaled = np.clip((quad - low) * scale, 0.0, 255.0).astype(np.float32)
        return np.rint(cv2.GaussianBlur(scaled, (0, 0), BLUR_PX)).astype(np.uint8)

    return grey(first), grey(second)


def _consistent(flow: np.ndarray, back: np.ndarray) -> np.ndarray:
    """The flow with NaN where following it and then ``back`` does not return to the start."""
    gap = flow + sample(back, flow)
    return np.where(np.hypot(*gap) > CONSISTENCY_PX, np.float32(np.nan), flow)


def median_flow(
    n: int,
    raw: dict[int, np.ndarray],
    reliable: dict[int, np.ndarray],
    times: np.ndarray,
    step: int,
) -> np.ndarray:
    """Median of the reliable flow of the pairs around n, each where the surface of n was then."""
    duration = times[n + step] - times[n]
    apart_max = APART_MAX * abs(duration) + 1e-9 if duration != 0 else -1.0
    votes = [reliable[n]]
    for m in range(n - abs(step) + 1, n + abs(step)):
        apart = times[m] - times[n] if m in raw else math.inf
        if m != n and abs(apart) <= apart_max:
            votes.append(sample(reliable[m], raw[n], apart / duration))
    stack = np.stack(votes)
    known = np.isfinite(stack[:, 0]).sum(axis=0)
    filled = np.where(known > 0, stack, np.float32(0.0))  # a median of nothing would warn
    median = np.where(2 * known >= len(votes), np.nanmedian(filled, axis=0), np.nan)
    return median.astype(np.float32)


def sample(image: np.ndarray, flow: np.ndarray, factor: float = 1.0) -> np.ndarray:
    """Channels [C, H, W] at x + factor * flow(x), bilinear, edges repeated; NaN spreads."""
    import cv2

    y, x = np.indices(flow.shape[1:], dtype=np.float32)
    at = x + np.float32(factor) * flow[0], y + np.float32(factor) * flow[1]
    repeated = cv2.BORDER_REPLICATE
    return np.stack([cv2.remap(c, *at, cv2.INTER_LINEAR, borderMode=repeated) for c in image])
