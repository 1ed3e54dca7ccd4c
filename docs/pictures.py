"""Pictures of conventions.md, drawn from the equations that they show."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc

from gftorf_warp.constants import CANONICAL_SHIFTS, SPEED_OF_LIGHT

FREQUENCY = 20e6  # [Hz]
SLOPE = 4 * np.pi * FREQUENCY / SPEED_OF_LIGHT  # [rad/m] of the phase
NAMES = ("+cos", "-cos", "+sin", "-sin")
COLOURS = ("#0072b2", "#56b4e9", "#d55e00", "#e69f00")  # of Okabe and Ito
GREY, GOOD, BAD = "#7f7f7f", "#009e73", "#cc3344"  # seen on white and on black
RATE = 120.0  # [Hz] raw frames
NEAR, FAR, PASSES_S = 3.0, 5.5, 5.5 / RATE  # [m] before and behind an edge that passes a pixel


def write(folder: Path) -> None:
    """Draw all pictures into ``folder``."""
    for name, figure in (("quads", quads()), ("phasor", phasor()), ("ray", ray())):
        figure.savefig(folder / f"{name}.svg", transparent=True, bbox_inches="tight")


def distance_at(time: np.ndarray) -> np.ndarray:
    """True distance [m] of a pixel that an edge passes."""
    return np.where(time < PASSES_S, FAR, NEAR)


def quad(distance: np.ndarray, shift: float) -> np.ndarray:
    """Return a cos(psi - theta), with a = 1 / d^2."""
    return np.cos(SLOPE * distance - shift) / distance**2


def quads() -> Figure:
    """Raw frames of one pixel over time, and the distances that quartets decode to."""
    figure = Figure(figsize=(8, 4.6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    instants = np.linspace(-0.5, 11.5, 600) / RATE
    measured = np.arange(12) / RATE
    values = np.empty(12)
    for slot, shift in enumerate(CANONICAL_SHIFTS):
        values[slot::4] = quad(distance_at(measured[slot::4]), shift)
        line = quad(distance_at(instants), shift)
        above.plot(1e3 * instants, line, color=COLOURS[slot], linewidth=1, alpha=0.5)
        label = f"θ = {np.degrees(shift):.0f}°, {NAMES[slot]}"
        dots = 1e3 * measured[slot::4], values[slot::4]
        above.plot(*dots, "o", color=COLOURS[slot], label=label)
    above.set_ylabel("quad")
    above.legend(
        ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1), frameon=False, labelcolor=GREY
    )
    below.plot(1e3 * instants, distance_at(instants), color=GOOD, label="true distance")
    for start in (0, 4, 8):
        ends = 1e3 * (start - 0.4) / RATE, 1e3 * (start + 3.4) / RATE
        for axes in (above, below):
            axes.axvspan(*ends, color=GREY, alpha=0.12, linewidth=0)
        plus, minus, sine, minus_sine = values[start : start + 4]
        phase = np.arctan2(sine - minus_sine, plus - minus) % (2 * np.pi)
        label = "closed form of a quartet" if start == 0 else None
        below.plot(ends, [phase / SLOPE] * 2, color=BAD, linewidth=3, alpha=0.8, label=label)
    below.set(xlabel="time [ms]", ylabel="distance [m]", ylim=(0, 7.6))
    below.legend(loc="upper right", ncols=2, frameon=False, labelcolor=GREY)
    for axes in (above, below):
        soften(axes)
    return figure


def phasor() -> Figure:
    """Quads of one distance as a cosine of the shift, and as a vector."""
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    phase, amplitude = np.radians(55), 1.0
    shifts = np.linspace(0, 2 * np.pi, 200)
    left.plot(np.degrees(shifts), amplitude * np.cos(phase - shifts), color=GREY)
    for shift, colour, name in zip(CANONICAL_SHIFTS, COLOURS, NAMES, strict=True):
        value = amplitude * np.cos(phase - shift)
        left.plot(np.degrees(shift), value, "o", color=colour)
        place = {"textcoords": "offset points", "xytext": (8, 4), "color": colour}
        left.annotate(name, (np.degrees(shift), value), **place)
    left.axvline(np.degrees(phase), color=GOOD, linewidth=1, linestyle="--")
    left.annotate("ψ", (np.degrees(phase) + 5, -0.95), color=GOOD, fontsize=13)
    left.set(xlabel="phase shift θ [°]", ylabel="quad", xticks=range(0, 361, 90), ylim=(-1.15, 1.3))
    end = 2 * amplitude * np.cos(phase), 2 * amplitude * np.sin(phase)
    arrow = {"arrowprops": {"arrowstyle": "-|>", "color": GREY, "linewidth": 2}}
    right.annotate("", end, (0, 0), **arrow)
    right.annotate("2a", (end[0] / 2 - 0.28, end[1] / 2 + 0.1), color=GREY, fontsize=13)
    right.add_patch(Arc((0, 0), 1.1, 1.1, theta2=np.degrees(phase), color=GOOD))
    right.annotate("ψ", (0.6, 0.25), color=GOOD, fontsize=13)
    right.plot([end[0]] * 2, [0, end[1]], ":", color=COLOURS[2])
    right.plot([0, end[0]], [end[1]] * 2, ":", color=COLOURS[0])
    right.set(xlabel="re = (+cos) - (-cos)", ylabel="im = (+sin) - (-sin)", aspect="equal")
    right.set(xlim=(-0.4, 2.2), ylim=(-0.4, 2.2))
    for axes in (left, right):
        axes.axhline(0, color=GREY, linewidth=0.5)
        soften(axes)
    right.axvline(0, color=GREY, linewidth=0.5)
    return figure


def ray() -> Figure:
    """Distance along the ray and z-depth of one point, in the axes of a camera."""
    figure = Figure(figsize=(8, 3), layout="constrained")
    axes = figure.subplots()
    point = np.array([4.0, 1.6])  # z, y
    axes.plot([0, point[0]], [0, point[1]], color=GOOD, linewidth=2)
    axes.plot([0, point[0]], [0, 0], color=BAD, linewidth=2)
    axes.plot([point[0]] * 2, [0, point[1]], ":", color=GREY)
    axes.plot([point[0]] * 2, [-0.9, 2.2], color=GREY, linewidth=4, alpha=0.4)
    axes.plot(*point, "o", color=GREY)
    axes.plot([1.0] * 2, [-0.55, 0.55], color=GREY)  # the image
    axes.annotate("image", (1.0, -0.62), ha="center", color=GREY)
    axes.annotate("distance d, along the ray", (1.7, 0.98), color=GOOD, rotation=-19)
    axes.annotate("z-depth", (2.5, -0.1), color=BAD)
    axes.annotate("wall", (4.08, -0.7), color=GREY)
    tips = {"z, forward": (0.9, 0.0), "y, down": (0.0, 0.9)}
    for name, tip in tips.items():
        axes.annotate("", tip, (0, 0), arrowprops={"arrowstyle": "-|>", "color": GREY})
        axes.annotate(name, (tip[0] - 0.7, tip[1] + (0.25 if tip[1] else -0.1)), color=GREY)
    axes.plot(0, 0, "s", color=GREY, markersize=9)
    axes.annotate("camera", (-0.62, -0.2), color=GREY)
    axes.set(xlim=(-0.7, 4.8), ylim=(2.3, -1.0), aspect="equal")
    axes.set_axis_off()
    return figure


def soften(axes: Axes) -> None:
    """Lines and letters of axes in a grey that is seen on white and on black."""
    axes.tick_params(colors=GREY)
    axes.xaxis.label.set_color(GREY)
    axes.yaxis.label.set_color(GREY)
    for side, spine in axes.spines.items():
        spine.set_color(GREY)
        spine.set_visible(side in ("left", "bottom"))
