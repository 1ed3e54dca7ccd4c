"""Numbers used by several packages, each with its reason."""

import math

SPEED_OF_LIGHT = 299_792_458.0  # [m/s] exact, by definition of the metre
ALPHA_MAX = 0.99  # keeps 1 / (1 - alpha) in the backward pass below 100
# a fainter splat moves an 8-bit colour by less than a step; phasors weigh it less still
ALPHA_MIN = 1.0 / 255.0
# a pixel stops here: what lies behind can add 1e-4 of a distance and 1e-8 of a quad
TRANSMITTANCE_MIN = 1e-4
# [px^2] added to a projected covariance, so that a splat covers about a pixel (EWA filter)
LOW_PASS = 0.3
# the projection is linearised inside this multiple of the half field of view, clamped outside
GUARD = 1.3
SH_COEFFICIENTS = 16  # K = (degree + 1)^2 for degree 3
SH_Y0 = 0.28209479177387814  # 1 / (2 sqrt(pi)), the constant harmonic
SH_BIAS = 0.5  # an all-zero coefficient vector means mid grey, as in published Gaussian splats
# raw frames of one depth image, unless a recording says otherwise, see Sequence.cycle
FRAMES_PER_QUARTET = 4
FRAME_RATE_HZ = 120.0  # [Hz] raw frames per second of the F-ToeRF recordings
# [rad] order in memory: +cos, -cos, +sin, -sin
CANONICAL_SHIFTS = (0.0, math.pi, math.pi / 2, 3 * math.pi / 2)
WINDOW = 11  # taps of the Gaussian window of the similarity, as published for images of 8 bits
WINDOW_SIGMA = 1.5  # [px] standard deviation of that window
# (0.01 L)^2 for a range L = 1: keeps the comparison of means defined in black regions
STABILISE_MEAN = 1e-4
STABILISE_SPREAD = 9e-4  # (0.03 L)^2, the same for the comparison of contrasts
# where the distance of a pixel is from, by the values 0 to 3 of a map of sources: recon/fallback.py
# and, for the last one, recon/outlines.py
SOURCES = ("fit", "temporal", "closed_form", "outline")
