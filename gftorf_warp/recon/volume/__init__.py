"""Neural volumes, methods ``torf``, ``ftorf`` and ``volume``: rays, networks, compositing, a loop.

The facts of both publications that the first two follow are those of neural_volumes.md; every file
cites its sections. What was not published, or is done in another way, is listed by each method,
logged at the start of a run and kept in its config.json.
"""
