"""Neural volumes, the methods ``torf`` and ``ftorf``: rays, networks, compositing, losses, a loop.

The facts of both publications that this follows are those of neural_volumes.md; every file cites
its sections. What was not published, or is done in another way, is listed by each method, logged at
the start of a run and kept in its config.json.
"""
