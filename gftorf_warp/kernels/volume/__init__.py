"""The grids of a neural volume.

hash_grid   features of points, interpolated in one level of a hash grid, and the adjoint
"""
