"""Failures put into the start of a reconstruction, to see what notices them."""

from dataclasses import replace

import numpy as np
import torch

BLACK = -3.0  # constant harmonic: reflectivity is clamped at zero from -1.77 on, without a gradient


def veil(state):
    """Black, opaque Gaussians of a metre each right before the camera: they cover everything."""
    tensors = state.optimiser.tensors
    with torch.no_grad():
        tensors["reflectivity_sh"][:, 0] = BLACK
        tensors["opacity_logit"][:] = 4.0
        tensors["log_scale"][:] = 0.0


def far_off(state):
    """Every Gaussian half as far again, as a wrong turn of the phase puts it; still as bright."""
    tensors = state.optimiser.tensors
    with torch.no_grad():
        tensors["mean"] *= 1.5
        tensors["reflectivity_sh"] *= 1.5**2


def nan_flow(sequence):
    """Optical flow that is unknown everywhere."""
    return _flow(sequence, lambda flow: np.full_like(flow, np.nan))


def turned_flow(sequence):
    """Optical flow of the wrong sign."""
    return _flow(sequence, np.negative)


def _flow(sequence, change):
    fields = {
        name: {n: change(flow) for n, flow in getattr(sequence.flow, name).items()}
        for name in ("forward", "backward")
    }
    return replace(sequence, flow=replace(sequence.flow, **fields))
