"""Gaussians displaced to a time.

displace   centres, orientations and channels as weighted sums over keys, and their adjoint
move       Gaussians of a finished run at a time and for a camera
"""
