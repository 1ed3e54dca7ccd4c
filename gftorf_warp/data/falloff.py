"""Fall-off: how well a hypothesis about phase explains that far surfaces are darker.

Light returns as r / d^2, on a tilted plane as about r / d^3. Between neighbouring pixels of one
surface, log a therefore changes by -p times log d, p between 2 and 3, whatever the reflectivity,
plus its texture, which does not know the distance. A mirrored phase turns the sign of that
relation, an offset changes p with the distance, and where it makes a surface wrap, log d jumps and
a does not. A common factor of all distances, as of a wrong modulation frequency, changes nothing.

With g and u the differences of log a and log d over pairs of pixels, the measure is

    min over p of  sum min(|g + p u|, c) / sum min(|g|, c),

one without any relation, below one if the distances explain amplitudes. On 48 simulated scenes with
direct light it is 0.50 to 0.98 as recorded and above 1.03 mirrored.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float

STRIDES = (1, 2, 3)  # [px] between the two pixels of a pair: one is often less than the noise
EXPONENTS = (2.0, 2.5, 3.0)  # p of a frontal and of a tilted surface
# and of what is stated, the more lenient: indirect light, balls and lenses that darken corners
LENIENT = (1.5, *EXPONENTS, 4.0, 6.0)
CAP = 0.7  # [1] c: a factor of two in amplitude between neighbours is an outline, not fall-off
SAME_SURFACE_RAD = 0.4  # [rad] phases of neighbours that differ more belong to two surfaces
DARK = 0.2  # share of the pixels, the darkest, whose phase is noise
PAIRS_MIN = 500  # fewer pairs leave the measure uncertain by several hundredths
PAIRS_MAX = 40_000  # more do not change its second digit
NEAREST = 1e-3  # [turns] least distance: its logarithm is taken


@dataclass(frozen=True, kw_only=True, eq=False)
class Pairs:
    """Phases and amplitudes of pairs of neighbouring pixels of one surface."""

    gain: Float[np.ndarray, "P"]
    """Difference g of log amplitude."""
    phases: Float[np.ndarray, "2 P"]
    """Measured phases [rad]."""

    def measure(self, offset: float, exponents: tuple[float, ...] = EXPONENTS) -> float:
        """The measure above for a phase offset [rad]."""
        turns = np.mod((self.phases - offset) / (2.0 * np.pi), 1.0) + NEAREST
        u = np.diff(np.log(turns), axis=0)[0]
        none = float(np.minimum(np.abs(self.gain), CAP).sum())
        left = [float(np.minimum(np.abs(self.gain + p * u), CAP).sum()) for p in exponents]
        return min(left) / none if none > 0.0 else 1.0


def pairs_of(phasors: list[Complex[np.ndarray, "H W"]]) -> Pairs | None:
    """Pairs of neighbours in images of one or several instants; None if there are too few."""
    firsts, seconds = [], []
    for image in phasors:
        dark = np.quantile(np.abs(image), DARK)
        for stride in STRIDES:
            for a, b in (
                (image[:-stride], image[stride:]),
                (image[:, :-stride], image[:, stride:]),
            ):
                bright = np.minimum(np.abs(a), np.abs(b)) > dark
                near = np.abs(np.angle(a * b.conj())) < SAME_SURFACE_RAD
                firsts.append(a[bright & near])
                seconds.append(b[bright & near])
    a, b = np.concatenate(firsts), np.concatenate(seconds)
    if len(a) < PAIRS_MIN:
        return None
    chosen = np.linspace(0, len(a) - 1, min(len(a), PAIRS_MAX)).round().astype(int)
    a, b = a[chosen], b[chosen]
    return Pairs(
        gain=np.log(np.abs(b) / np.abs(a)),
        phases=np.stack([np.angle(a), np.angle(b)]),
    )
