"""What a tracer knows beside distance and amplitude, as named images: the layers of a recording's truth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ..render.trace import FirstHits, Light
from ..scene.sensor import Sensor

TRUTHS = ("usual", "all")
"""How much is kept: what cannot be computed from the rest of a capture and is small, or everything there is."""


def layers(
    light: Light, hits: FirstHits, sensor: Sensor, amount: str, *, bounced: bool
) -> dict[str, Float[np.ndarray, "C H W"]]:
    """Images by the names of data_specs/capture.toml, float32, channels in the order that stands there.

    Light is the mean over the exposure, for the sensor's source intensity and without its phase offset; depth and
    normals are those of the middle of the exposure.

    Args:
        light: Of one raw frame.
        hits: What the centre rays meet.
        sensor: Its source intensity, and the harmonics of ``light``.
        amount: One of ``TRUTHS``. 'usual' has ``ambient`` and, of light that bounced, the part ``direct`` that did not
            and the standard ``error``; 'all' has the light at every harmonic, ``z_depth`` and ``normal`` too.
        bounced: Whether ``light`` has any that met more than one surface.

    Raises:
        ValueError: If there is no such amount.
    """
    if amount not in TRUTHS:
        raise ValueError(f"truth {amount!r} must be one of {', '.join(TRUTHS)}")
    intensity = float(sensor.source_intensity)
    found = {"ambient": [light.ambient]}
    if bounced:
        found["direct"] = [*_parts(intensity * light.direct[0]), intensity * light.direct_amplitude]
        found["error"] = [intensity * light.error]
    if amount == "all":
        for harmonic, image in zip(sensor.harmonics, light.light, strict=True):
            found[f"phasor.{harmonic}"] = _parts(intensity * image)
        found["z_depth"] = [hits.z_depth]
        found["normal"] = list(np.moveaxis(hits.normal, -1, 0))
    return {name: np.stack(images).astype(np.float32) for name, images in found.items()}


def _parts(image: np.ndarray) -> list[np.ndarray]:
    return [image.real, image.imag]
