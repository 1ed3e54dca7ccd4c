"""Images of engine mesh besides distance and amplitude: the layers of the truth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ..render.trace import FirstHits, Light
from ..scene.sensor import Sensor


def truth_layers(
    light: Light, hits: FirstHits, sensor: Sensor, amount: str, *, bounced: bool
) -> dict[str, Float[np.ndarray, "C H W"]]:
    """Images by the names of data_specs/capture.toml, float32, channels in the order given there.

    Light is the mean over the exposure, for the sensor's source intensity and without its phase
    offset; depth and normals are those of the middle of the exposure.

    The ``amount`` 'usual' is ``ambient`` and, if light ``bounced``, its direct part ``direct`` and
    its standard ``error``: small, and not computable from the rest of a capture; 'all' is also the
    light at every harmonic, ``z_depth`` and ``normal``.
    """
    intensity = float(sensor.source_intensity)
    named = {"ambient": [light.ambient]}
    if bounced:
        named["direct"] = [*_parts(intensity * light.direct[0]), intensity * light.direct_amplitude]
        named["error"] = [intensity * light.error]
    if amount == "all":
        for harmonic, image in zip(sensor.harmonics, light.light, strict=True):
            named[f"phasor.{harmonic}"] = _parts(intensity * image)
        named["z_depth"] = [hits.z_depth]
        named["normal"] = list(np.moveaxis(hits.normal, -1, 0))
    return {name: np.stack(images).astype(np.float32) for name, images in named.items()}


def _parts(image: np.ndarray) -> list[np.ndarray]:
    return [image.real, image.imag]
