"""Rays through meshes, for ``simulate --engine mesh``. In launch order:

rays          what a ray meets first
light_paths   direct light, and indirect light by random paths
"""
