"""Contact sheet of a sequence: quads of a quartet, amplitude, distances, errors, flow, colour."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from ..constants import SPEED_OF_LIGHT
from ..errors import InputError
from .cycles import determined, frequencies_by_order
from .decode import Decoded, decode_quartet, unambiguous_range
from .images import png_bytes
from .sequence import Sequence, Truth
from .truth import known_distance

PANEL = 340  # [px] width of an image on the sheet
# [px] width of a colour bar, its distance from the image, width of its numbers
BAR, BAR_GAP, BAR_TEXT = 12, 8, 70
TITLE, GAP, MARGIN = 30, 18, 24  # [px] height of a title, space between panels, around all of them
HEAD = 70  # [px] height of the heading
INK, SOFT, UNKNOWN = (32, 32, 32), (110, 110, 110), (200, 200, 200)
CLIP = 99.5  # percentile at which a scale ends, so that a wrapped pixel does not darken all others
COLUMNS = 4
PALETTE = (  # of Okabe and Ito
    *((230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66)),
    *((0, 114, 178), (213, 94, 0), (204, 121, 167)),
)

Picture = UInt8[np.ndarray, "h w 3"]
Colours = Callable[[Float[np.ndarray, "H W"]], Picture]


@dataclass(frozen=True, kw_only=True, eq=False)
class Panel:
    """One image with its title and its scale."""

    title: str
    """Content, with its unit."""
    image: Picture
    """Red, green, blue."""
    scale: tuple[float, float, Colours] | None = None
    """Lowest and highest value and the colours between; None: no colour bar."""


def contact_sheet(sequence: Sequence, truth: Truth | None, title: str) -> bytes:
    """PNG of the middle quartet of a sequence."""
    n, panels = middle_panels(sequence, truth)
    return painted(sequence, title, f"the quartet of raw frame {n}", panels)


def painted(sequence: Sequence, title: str, shown: str, panels: list[list[Panel]]) -> bytes:
    """PNG of rows of panels, all as large as images of the sequence, under a heading."""
    height = max(1, round(PANEL * sequence.height / sequence.width))
    cell = PANEL + BAR_GAP + BAR + BAR_TEXT
    rows = 2 * MARGIN + HEAD + len(panels) * (TITLE + height + GAP)
    sheet = np.full((rows, 2 * MARGIN + COLUMNS * (cell + GAP) - GAP, 3), 255, dtype=np.uint8)
    _write(sheet, title, (MARGIN, MARGIN + 22), 24, INK, bold=True)
    used = frequencies_by_order(sequence.frame_frequencies)
    about = (
        f"{int(sequence.measured.sum())} raw frames of {sequence.width}x{sequence.height} pixels, "
        f"{', '.join(f'{f / 1e6:.6g}' for f in used)} MHz, {sequence.times[-1]:.3g} s; "
        f"shown: {shown}. A picture for people, no data."
    )
    _write(sheet, about, (MARGIN, MARGIN + 48), 15, SOFT)
    for i, row in enumerate(panels):
        for j, panel in enumerate(row):
            x, y = MARGIN + j * (cell + GAP), MARGIN + HEAD + i * (TITLE + height + GAP)
            _place(sheet, panel, x, y, height)
    return png_bytes(sheet)


def middle_panels(sequence: Sequence, truth: Truth | None) -> tuple[int, list[list[Panel]]]:
    """First raw frame of the middle quartet, and its panels in rows."""
    quartets = _decodable(sequence)
    n = int(np.flatnonzero(sequence.measured)[0])
    if quartets:
        n = sequence.cycle * quartets[len(quartets) // 2]
    whole = bool(quartets)
    rows = _raw(sequence, n), _decoded(sequence, truth, n, whole), _more(sequence, truth, n)
    return n, [row[i : i + COLUMNS] for row in rows for i in range(0, len(row), COLUMNS)]


def _decodable(sequence: Sequence) -> list[int]:
    """Complete quartets whose shifts determine a phase at every frequency."""
    try:
        unambiguous_range(sequence)
    except InputError:  # its frequencies have nothing in common
        return []

    def decodable(i: int) -> bool:
        frames = sequence.quartet_frames(i)
        return determined(sequence.shifts[frames], sequence.frame_frequencies[frames])

    return [i for i in sequence.complete_quartets if decodable(i)]


def _raw(sequence: Sequence, n: int) -> list[Panel]:
    """The raw frames of a quartet on one scale."""
    frames = [m for m in range(n, min(n + sequence.cycle, sequence.frames)) if sequence.measured[m]]
    end = float(np.percentile(np.abs(sequence.quads[frames]), CLIP)) or 1.0
    several, panels = len(sequence.frequencies) > 1, []
    for m in frames:
        shift, time_ms = math.degrees(sequence.shifts[m]), 1e3 * sequence.times[m]
        name = f"raw frame {m}: {shift:.4g} deg, {time_ms:.2f} ms"
        name += f", {sequence.frame_frequencies[m] / 1e6:.4g} MHz" if several else ""
        panels.append(scaled(name, sequence.quads[m], (-end, end), diverging))
    return panels


def _decoded(sequence: Sequence, truth: Truth | None, n: int, whole: bool) -> list[Panel]:
    """Amplitude, true distance, closed form and its error, each frequency by itself, if known."""
    panels = []
    true = None if truth is None else known_distance(truth)[n]
    quartet = decode_quartet(sequence, n // sequence.cycle) if whole else None
    if quartet is not None:
        amplitude = 0.5 * np.hypot(*quartet.phasors[0])
        ends = 0.0, _end(amplitude)
        panels.append(scaled("amplitude of the closed form", amplitude, ends, _gray))
        ends = float(quartet.distance.min()), float(quartet.distance.max())
    elif truth is not None and truth.amplitude is not None:
        amplitude = truth.amplitude[n].astype(np.float64)
        panels.append(scaled("amplitude without noise", amplitude, (0.0, _end(amplitude)), _gray))
    if true is not None:
        if not np.isfinite(true).any():
            return panels
        ends = float(np.nanmin(true)), float(np.nanmax(true))
        panels.append(scaled("true distance [m]", true, ends, viridis))
    if quartet is not None:
        panels.append(scaled("closed form [m]", quartet.distance, ends, viridis))
        if true is not None:
            error = np.abs(quartet.distance - true)
            ends = 0.0, _end(error)
            panels.append(scaled("error of the closed form [m]", error, ends, _inferno))
        panels += _by_frequency(sequence, quartet)
    return panels


def _by_frequency(sequence: Sequence, quartet: Decoded) -> list[Panel]:
    """Distance of each of several frequencies by itself, and their agreement."""
    if quartet.confidence is None:
        return []
    panels = []
    for f, image in zip(sequence.frequencies, quartet.single, strict=True):
        ends = 0.0, SPEED_OF_LIGHT / (2.0 * f)
        title = f"{f / 1e6:.4g} MHz alone, to {ends[1]:.3g} m [m]"
        panels.append(scaled(title, image, ends, viridis))
    title = f"confidence, {100 * float(quartet.ambiguous.mean()):.3g} % ambiguous"
    return [*panels, scaled(title, quartet.confidence, (0.0, 1.0), _gray)]


def _more(sequence: Sequence, truth: Truth | None, n: int) -> list[Panel]:
    """Effect of indirect light on the distance, objects, flow and colour, if known."""
    panels = []
    if truth is not None and truth.phasor_distance is not None:
        difference = truth.phasor_distance[n] - known_distance(truth)[n]
        # of one frequency, whose range may be shorter than the scene
        if len(sequence.frequencies) > 1:
            alone = SPEED_OF_LIGHT / (2.0 * sequence.frame_frequencies[n])
            difference = np.mod(difference + 0.5 * alone, alone) - 0.5 * alone
        end, title = max(_end(np.abs(difference)), 1e-3), "static phasor - true distance [m]"
        panels.append(scaled(title, difference, (-end, end), diverging))
    if truth is not None and truth.body is not None:
        colours = np.array([(255, 255, 255), *PALETTE], dtype=np.uint8)
        body = truth.body[n]
        index = np.where(body < 0, 0, 1 + body % len(PALETTE))
        title = f"objects, {len(np.unique(body[body >= 0]))} in view"
        panels.append(Panel(title=title, image=colours[index]))
    flow = sequence.flow.forward.get(n)
    if flow is not None:
        length = np.hypot(*flow)
        end = max(float(np.nanmax(length)) if np.isfinite(length).any() else 0.0, 1e-6)
        title = f"flow to raw frame {n + sequence.cycle}, up to {end:.3g} px"
        panels.append(Panel(title=title, image=_flow(flow, end)))
    image = sequence.colour.images.get(n)
    if image is not None:
        top = float(np.percentile(image, CLIP)) or 1.0
        picture = _eight_bits(np.clip(image / top, 0, 1) ** (1 / 2.2))
        panels.append(Panel(title=f"colour, raw frame {n}", image=picture))
    return panels


def scaled(title: str, image: np.ndarray, ends: tuple[float, float], colours: Colours) -> Panel:
    """An image in false colours between two values; NaN is grey."""
    low, high = ends if ends[1] > ends[0] else (ends[0] - 0.5, ends[0] + 0.5)
    with np.errstate(invalid="ignore"):
        share = np.clip((image - low) / (high - low), 0.0, 1.0)
    painted = colours(np.nan_to_num(share, nan=0.0))
    painted[np.isnan(image)] = UNKNOWN
    return Panel(title=title, image=painted, scale=(low, high, colours))


def _place(sheet: Picture, panel: Panel, x: int, y: int, height: int) -> None:
    """Draw a panel with its upper left corner at x, y [px]."""
    import cv2

    _write(sheet, panel.title, (x, y + 20), 16, INK)
    top = y + TITLE
    h, w = panel.image.shape[:2]
    factor = min(PANEL / w, height / h)
    size = max(1, round(w * factor)), max(1, round(h * factor))
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_NEAREST
    resized = cv2.resize(panel.image, size, interpolation=method)
    sheet[top : top + size[1], x : x + size[0]] = resized
    # white may be a value
    cv2.rectangle(sheet, (x - 1, top - 1), (x + size[0], top + size[1]), UNKNOWN, 1)
    if panel.scale is None:
        return
    low, high, colours = panel.scale
    left = x + PANEL + BAR_GAP
    ramp = np.linspace(1.0, 0.0, height)[:, None]
    sheet[top : top + height, left : left + BAR] = colours(np.repeat(ramp, BAR, axis=1))
    middle = (low + high) / 2, top + height // 2 + 5
    for value, at in ((high, top + 12), middle, (low, top + height - 2)):
        _write(sheet, f"{value:.3g}", (left + BAR + 6, at), 14, INK)


def _write(
    sheet: Picture, text: str, at: tuple[int, int], size: int, colour, *, bold: bool = False
) -> None:
    """Text with the left end of its base line at (x, y) [px]."""
    import cv2

    cv2.putText(sheet, text, at, colour, cv2.FontFace("sans"), size, 700 if bold else 400)


def _end(image: np.ndarray) -> float:
    """Upper end of the scale of values that are never negative."""
    known = image[np.isfinite(image)]
    return float(np.percentile(known, CLIP)) if known.size else 1.0


def _eight_bits(image: np.ndarray) -> Picture:
    return np.round(255.0 * image).astype(np.uint8)


def _gray(share: np.ndarray) -> Picture:
    return _eight_bits(np.repeat(share[..., None], 3, axis=-1))


def _mapped(name: str, share: np.ndarray) -> Picture:
    import cv2

    coloured = cv2.applyColorMap(_eight_bits(share), getattr(cv2, name))
    return np.ascontiguousarray(coloured[..., ::-1])


viridis = functools.partial(_mapped, "COLORMAP_VIRIDIS")
_inferno = functools.partial(_mapped, "COLORMAP_INFERNO")


def diverging(share: np.ndarray) -> Picture:
    """Blue below the middle, white in it, red above."""
    x = 2.0 * share[..., None] - 1.0
    blue, red, white = np.array([(33, 102, 172), (178, 24, 43), (255, 255, 255)]) / 255.0
    return _eight_bits(white + np.abs(x) * (np.where(x < 0, blue, red) - white))


def _flow(flow: np.ndarray, end: float) -> Picture:
    """Direction as hue, length as saturation: white is no motion."""
    import cv2

    known = np.isfinite(flow).all(axis=0)
    dx, dy = np.nan_to_num(flow)
    hue = np.degrees(np.arctan2(dy, dx)) % 360.0 / 2.0
    strength = np.clip(np.hypot(dx, dy) / end, 0.0, 1.0)
    hsv = np.stack([hue, 255.0 * strength, np.full_like(hue, 255.0)], axis=-1).astype(np.uint8)
    image = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)
    image[~known] = UNKNOWN
    return image
