"""Calibrate a sensor through the renderer: recover its phase offset and DC offset from quads of a
known scene.

The fields of ``Sensor`` accept 0-d tensors, and those receive gradients like any parameter.
"""

import torch

from gftorf_warp import Camera, GaussianField, Sensor, rasterize
from gftorf_warp.scene.gaussians import constant_sh

TRUE_PHASE_OFFSET = 0.35  # [rad], 42 cm at 20 MHz
TRUE_DC_OFFSET = 0.2  # [1] of the amplitude


def wall(n: int = 400) -> GaussianField:
    """A bumpy wall of n Gaussians about 3 m away."""
    generator = torch.Generator().manual_seed(0)
    mean = torch.rand(n, 3, generator=generator) * torch.tensor([4.0, 3.0, 0.6]) + torch.tensor(
        [-2.0, -1.5, 2.7]
    )
    return GaussianField(
        mean=mean,
        log_scale=torch.full((n, 3), -2.0),
        quaternion=torch.nn.functional.normalize(torch.randn(n, 4, generator=generator)),
        opacity_logit=torch.full((n,), 1.5),
        reflectivity_sh=constant_sh(torch.rand(n, generator=generator)),
    )


def main(steps: int = 200) -> tuple[float, float]:
    """Return the recovered (phase offset [rad], DC offset [1])."""
    field, camera = wall(), Camera.from_fov(40, 30, horizontal_fov_deg=60.0)
    measured = rasterize(
        field, camera, Sensor(phase_offset=TRUE_PHASE_OFFSET, dc_offset=TRUE_DC_OFFSET)
    ).quads

    phase_offset = torch.zeros((), requires_grad=True)
    dc_offset = torch.zeros((), requires_grad=True)
    optimiser = torch.optim.Adam([phase_offset, dc_offset], lr=0.02)
    for step in range(steps):
        optimiser.zero_grad()
        sensor = Sensor(phase_offset=phase_offset, dc_offset=dc_offset)
        loss = (
            rasterize(field, camera, sensor).quads - measured
        ).square().mean() / measured.square().mean()
        loss.backward()
        optimiser.step()
        if step % 50 == 0:
            print(
                f"step {step}: relative loss {loss.item():.2e}, phase offset "
                f"{phase_offset.item():.4f} rad"
            )
    print(f"recovered phase offset {phase_offset.item():.4f} rad (true {TRUE_PHASE_OFFSET})")
    print(f"recovered DC offset    {dc_offset.item():.4f}     (true {TRUE_DC_OFFSET})")
    return phase_offset.item(), dc_offset.item()


if __name__ == "__main__":
    main()
