"""Reconstruction: Gaussians and their motion, fitted to raw quads."""
