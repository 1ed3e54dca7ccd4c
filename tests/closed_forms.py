"""Closed forms of a sensor that tests compare with: what a cycle decodes to,
failures of unwrapping, wiggling.
"""

import math

import numpy as np

from gftorf_warp.scene.sensor import phasor_from_quads
from gftorf_warp.scene.unwrap import distance_from_phasors


def cycle_distance(quads, sensor):
    """Distance [m] in [0, c / 2 f_0) of the raw frames [cycle, ...] of one cycle,
    in the order of ``sensor.cycle``.
    """
    sets = quads.reshape(-1, len(sensor.shifts), *quads.shape[1:])
    return distance_from_phasors([phasor_from_quads(one, sensor.shifts) for one in sets], sensor)


def unwrap_failure(sigma, m1, m2):
    """Probability that unwrapping of two phases takes a wrong candidate,
    noise ``sigma`` [rad] on both.
    """
    return math.erfc(math.pi / (sigma * math.sqrt(2.0 * (m1**2 + m2**2))))


def wiggling(phase, ratios, samples):
    """Decoded minus true phase [rad] of ``samples`` equally spaced shifts, to first order in the
    harmonics' ratios.

    A harmonic is aliased to the fundamental if it is a neighbour of a multiple of the number of
    shifts, and has no effect otherwise (sensor notes, 2.6).
    """
    error = np.zeros(np.shape(phase))
    for h, ratio in enumerate(ratios, start=2):
        if (h - 1) % samples == 0:
            error = error + ratio * np.sin((h - 1) * phase)
        if (h + 1) % samples == 0:
            error = error - ratio * np.sin((h + 1) * phase)
    return error
