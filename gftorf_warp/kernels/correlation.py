"""The C-ToF model of a point: distance and reflectivity to light, and light to quads.

    a = s r / d^2,   psi = kappa d + phase_offset,   light = (a cos psi, a sin psi, a)
    quad of shift theta = a (cos(psi - theta) + b) = light . (cos theta, sin theta, b)

(paper, equations 1-3; method, section 2.4). Light is what is composited: quads of any number of
shifts are linear in it.
"""

import warp as wp

# entries of the calibration array
PHASE_SLOPE, PHASE_OFFSET, SOURCE_INTENSITY, DC_OFFSET = range(4)


@wp.func
def light_of(
    distance: float, reflectivity: float, slope: float, offset: float, intensity: float
) -> wp.vec3:
    """What a point sends back: (a cos psi, a sin psi, a) at ``distance`` [m]."""
    amplitude = intensity * reflectivity / (distance * distance)
    phase = slope * distance + offset
    return wp.vec3(amplitude * wp.cos(phase), amplitude * wp.sin(phase), amplitude)


@wp.func
def quad_of(light: wp.vec3, shift: wp.vec2, dc_offset: float) -> float:
    """A quad's value for ``light``; ``shift`` holds (cos theta, sin theta) of its phase shift."""
    return shift[0] * light[0] + shift[1] * light[1] + dc_offset * light[2]
