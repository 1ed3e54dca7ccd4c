"""Motion along cubic B-splines: the displacements of nodes at the keys are control points.

With u in [0, 1) of the way from key i to the next,

    x(t) = x + 1/6 ((1 - u)^3 o_{i-1} + (3 u^3 - 6 u^2 + 4) o_i + (-3 u^3 + 3 u^2 + 3 u + 1) o_{i+1}
    + u^3 o_{i+2})

which has two continuous derivatives where keys are evenly spaced. Beyond either end one control
point continues the last two in a straight line, so that the curve begins at the first control point
and ends at the last, and a line is reproduced exactly.
"""

from __future__ import annotations

from .motion import Keys, Nodes


class Spline(Nodes):
    """Nodes whose displacements are splines in time."""

    kind = "spline"
    support = 4

    def keys_at(self, time: float) -> Keys:
        """Up to four keys; constant before the first key and after the last."""
        key, u = self.interval(time)
        cubics = (1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3
        last, sums = len(self.times) - 1, dict.fromkeys(range(len(self.times)), 0.0)
        for control, cubic in enumerate(cubics, start=key - 1):
            nearest = min(max(control, 0), last)
            if control == nearest:
                sums[control] += cubic / 6
            elif cubic:
                sums[nearest] += 2 * cubic / 6
                sums[2 * nearest - control] -= cubic / 6
        used = [index for index, weight in sums.items() if weight != 0.0]
        return Keys(tuple(used), tuple(sums[index] for index in used))
