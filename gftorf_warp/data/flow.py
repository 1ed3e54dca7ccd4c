"""Optical flow from raw frames, for recordings without flow: between frames of one shift, a cycle
apart.

Frames n and n + K have the same shift and frequency, K being the raw frames of a cycle, so a moving
surface looks nearly alike in both. The flow of quartet start n is the median over the pairs n + j
that start at most half a cycle away: pair n + j shows the surface a little earlier or later, at x +
s F(x), s being its time from n in units of the pair's length. Pairs of different shifts have their
weak contrast at different distances, and their noise is independent.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from .sequence import Flow, Sequence

Method = Literal["dis", "deepflow"]

# of a cycle: pairs that start farther from n have another motion where paths are curved
APART_MAX = 0.5
# [px] of forward and backward flow; occluded pixels disagree by the motion itself
CONSISTENCY_PX = 1.0
BLUR_PX = 0.7  # [px] before matching: halves the noise, keeps edges
SMALLEST_PX = 12  # [px] the matcher refuses smaller images
# [%] of pixels at either end that may saturate, so that one hot pixel does not set the scale
ROBUST_PERCENT = 0.05


def compute_flow(sequence: Sequence, *, method: Method = "dis") -> Flow:
    """Compute the optical flow of every quartet start whose partner a cycle away was measured too.

    Args:
        sequence: Its quads; stored flow is ignored.
        method: ``dis`` is fast and follows large motion; ``deepflow`` is smoother where motion
            stays below about two pixels in a cycle, and loses what moves farther.

    Returns:
        Forward and backward flow, float32. Pixels whose forward and backward flow disagree in most
        pairs are NaN.

    Raises:
        InputError: If the images are too small to match.
        ValueError: If the method has another name.
    """
    if method not in ("dis", "deepflow"):
        raise ValueError(f"method must be dis or deepflow, got {method!r}")
    if min(sequence.height, sequence.width) < SMALLEST_PX:
        raise InputError(
            "images too small for optical flow",
            where=sequence.path or "sequence",
            why=f"expected at least {SMALLEST_PX}x{SMALLEST_PX} pixels, found "
            f"{sequence.width}x{sequence.height}",
            fix="provide flow as files, or use larger images",
        )
    step, times, quads = sequence.cycle, sequence.times, sequence.quads
    pairs = [
        n
        for n in range(sequence.frames - step)
        if sequence.measured[n] and sequence.measured[n + step]
    ]

    def matched(n: int) -> tuple[np.ndarray, ...]:
        """Flow from n to n + K and back; each again, with NaN where they disagree."""
        match = _matcher(method)  # holds buffers: one for each call
        first, second = _grey(quads[n], quads[n + step])
        there, back = match(first, second), match(second, first)
        return there, back, _consistent(there, back), _consistent(back, there)

    # OpenCV releases Python's lock
    with ThreadPoolExecutor(thread_name_prefix="gftorf-flow") as threads:
        found = dict(zip(pairs, threads.map(matched, pairs), strict=True))
        forward, reliable_forward = ({n: flows[k] for n, flows in found.items()} for k in (0, 2))
        backward, reliable_backward = (
            {n + step: flows[k] for n, flows in found.items()} for k in (1, 3)
        )

        def combined(
            raw: dict[int, np.ndarray], reliable: dict[int, np.ndarray], step: int
        ) -> dict[int, np.ndarray]:
            starts = [n for n in range(0, sequence.frames, abs(step)) if n in raw]
            flows = threads.map(lambda n: median_flow(n, raw, reliable, times, step), starts)
            return dict(zip(starts, flows, strict=True))

        return Flow(
            forward=combined(forward, reliable_forward, step),
            backward=combined(backward, reliable_backward, -step),
        )


def warp_back(
    image: Float[np.ndarray, "H W"], flow: Float[np.ndarray, "2 H W"]
) -> Float[np.ndarray, "H W"]:
    """An image at x + flow(x): brings a later frame back to the earlier one, bilinear,
    edges repeated.
    """
    return _sample(image[None], flow, np.float32(1.0))[0]


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
    """Two quads [H, W] as uint8 images with one scale for both,
    so that equal light stays equally bright.
    """
    import cv2

    low, high = np.percentile(np.stack([first, second]), [ROBUST_PERCENT, 100.0 - ROBUST_PERCENT])
    scale = 255.0 / (high - low) if high > low else 0.0
    scaled = [
        np.clip((quad - low) * scale, 0.0, 255.0).astype(np.float32) for quad in (first, second)
    ]
    grey = [np.rint(cv2.GaussianBlur(quad, (0, 0), BLUR_PX)).astype(np.uint8) for quad in scaled]
    return grey[0], grey[1]


def _consistent(flow: np.ndarray, back: np.ndarray) -> np.ndarray:
    """The flow with NaN where following it and then ``back`` does not return to the start."""
    gap = flow + _sample(back, flow, np.float32(1.0))
    return np.where(np.hypot(*gap) > CONSISTENCY_PX, np.float32(np.nan), flow)


def median_flow(
    n: int,
    raw: dict[int, np.ndarray],
    reliable: dict[int, np.ndarray],
    times: np.ndarray,
    step: int,
) -> np.ndarray:
    """Median of the reliable flow of the pairs around n,
    each read where the surface of n was at its time.
    """
    duration = times[n + step] - times[n]
    votes = []
    for m in range(n - abs(step) + 1, n + abs(step)):
        if m == n:
            votes.append(reliable[n])
        elif (
            duration != 0
            and m in raw
            and abs(times[m] - times[n]) <= APART_MAX * abs(duration) + 1e-9
        ):
            votes.append(_sample(reliable[m], raw[n], np.float32((times[m] - times[n]) / duration)))
    stack = np.stack(votes)
    known = np.isfinite(stack[:, 0]).sum(axis=0)
    filled = np.where(known > 0, stack, np.float32(0.0))  # a median of nothing would warn
    return np.where(
        2 * known >= len(votes), np.nanmedian(filled, axis=0), np.float32(np.nan)
    ).astype(np.float32)


def _sample(image: np.ndarray, flow: np.ndarray, factor: np.float32) -> np.ndarray:
    """Channels [C, H, W] of ``image`` at x + factor * flow(x), bilinear, edges repeated;
    NaN spreads to neighbours.
    """
    import cv2

    y, x = np.indices(flow.shape[1:], dtype=np.float32)
    at_x, at_y = x + factor * flow[0], y + factor * flow[1]
    return np.stack(
        [
            cv2.remap(
                c, at_x, at_y, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            for c in image
        ]
    )
