"""Gaussians displaced to a time.

displace   centres between two keys, and displacements between keys as channels
move       Gaussians of a finished run at a time and for a camera
"""
