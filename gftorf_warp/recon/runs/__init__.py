"""Finished runs, a file for each kind: what ``Run.open`` returns.

    stored         what a folder states about a run, and its sequence
    base           ``Run``: a run of Gaussians, and what all kinds have in common
    gaussians      how Gaussians are rendered at a time
    moving         flow and static layer, for outlines that move
    empty          kinds without Gaussians
    closed_form    ``ctof``, ``temporal`` and ``flow2d``, which render their measurements
    volume         neural volumes
    windowed       runs of long recordings, window after window

``recon/run.py`` lists the kinds.
"""
