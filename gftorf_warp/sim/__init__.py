"""Simulation: scenes with moving bodies, an image for each raw frame, and the read-out with noise."""
