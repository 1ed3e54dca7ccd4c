"""Simulation and reconstruction of Gaussian scenes seen by continuous-wave time-of-flight cameras.

The public names are resolved on first use, so that ``import gftorf_warp`` stays instant.
"""

from __future__ import annotations

import importlib

__version__ = "0.1.0"

_HOME = {
    "Background": "render.api",
    "Camera": "scene.camera",
    "GaussianField": "scene.gaussians",
    "Rendering": "render.api",
    "RenderSettings": "render.buffers",
    "Run": "recon.run",
    "Sensor": "scene.sensor",
    "Sequence": "data.read",
    "SimSettings": "sim.settings",
    "Truth": "data.sequence",
    "compare": "evaluate.compare",
    "rasterize": "render.api",
    "reconstruct": "recon.train",
    "simulate": "sim.simulate",
}
__all__ = ["__version__", *_HOME]  # noqa: PLE0604 - the names are strings, the checker cannot see it


def __getattr__(name: str):
    """Import the package that defines ``name``."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
