"""Surfaces from distance images, for ``gftorf export``:

signed_distance  how far each node of a grid is in front of what several cameras see
"""
