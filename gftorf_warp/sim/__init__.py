"""Simulation: scenes with moving bodies, an image per raw frame, read-out with noise."""
