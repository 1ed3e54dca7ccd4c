"""Render one Gaussian as a C-ToF camera sees it, and decode its distance from the four quads
again.
"""

import math

import torch

from gftorf_warp import Camera, GaussianField, Sensor, rasterize
from gftorf_warp.scene.gaussians import constant_sh
from gftorf_warp.scene.sensor import distance_from_phasor, phasor_from_quads


def main() -> float:
    """Return the decoded distance [m] in the middle of the image."""
    camera = Camera.from_fov(64, 48, horizontal_fov_deg=60.0)
    sensor = Sensor(f_mod_hz=20e6, phase_offset=0.1)
    centre = torch.tensor([[0.2, -0.1, 2.5]])
    field = GaussianField(
        mean=centre,
        log_scale=torch.full((1, 3), math.log(0.15)),  # 15 cm in every direction
        quaternion=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        opacity_logit=torch.tensor([2.0]),
        reflectivity_sh=constant_sh(torch.tensor([0.6])),
    )

    rendering = rasterize(field, camera, sensor)
    print(f"quads {tuple(rendering.quads.shape)}, distance {tuple(rendering.distance.shape)}")

    re, im = phasor_from_quads(rendering.quads, sensor.shifts)
    decoded = distance_from_phasor(re, im, sensor)
    x, y = (int(v) for v in camera.project(centre)[0])  # the pixel that the centre falls into
    mean_distance = float(rendering.distance[y, x] / rendering.opacity[y, x])
    print(
        f"at pixel [{y}, {x}]: true {float(centre.norm()):.4f} m, rendered mean "
        f"{mean_distance:.4f} m,"
    )
    print(
        f"decoded from quads {float(decoded[y, x]):.4f} m, known modulo "
        f"{sensor.unambiguous_range:.3f} m"
    )
    return float(decoded[y, x])


if __name__ == "__main__":
    main()
