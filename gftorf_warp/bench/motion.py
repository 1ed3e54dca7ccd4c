"""The motion network: forward and backward for Q key times, encoding of positions included."""

from __future__ import annotations

import itertools
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..render.cublas import CublasLayers
from ..render.layers import Form
from ..render.network import HalfPrecision, with_backend
from ..render.tensor_cores import fits
from ..scene.gaussians import GaussianField, constant_sh
from ..scene.motion import MotionSettings, Products
from ..scene.network import Network
from .timing import Report, both_ways, lines_of, two_passes, watch_of

COUNTS = (20_000, 100_000)
QUICK_COUNTS = (100,)
QUERIES = (1, 2, 3)
KEYS, PERIOD_S, LENGTH_M = 16, 4 / 120, 7.5
BY_TORCH = "half by torch"  # by cuBLAS, for comparison with our kernels


def measure(device: str, *, quick: bool, runs: int, report: Report) -> list[dict[str, Any]]:
    """Rows of N, Q and precision: time of one forward and backward pass, and per query [ms].

    The network is the published one, 8 layers of 256. A CPU has one precision.
    """
    watch = watch_of(device)
    precisions = [str(Products.FLOAT32)] if torch.device(device).type == "cpu" else kinds(device)
    cases = [*itertools.product(QUICK_COUNTS if quick else COUNTS, QUERIES, precisions)]
    rows = []
    for done, (count, queries, products) in enumerate(cases, start=1):
        generator = torch.Generator().manual_seed(0)
        times = torch.arange(KEYS, dtype=torch.float64) * PERIOD_S
        settings = MotionSettings(kind=Network.kind, products=products_of(products))
        sizes = {"duration": float(times[-1]), "length": LENGTH_M}
        network = Network(times, settings, **sizes, generator=generator).to(device)
        set_backend(network, products)
        field = points(LENGTH_M * torch.rand(count, 3, generator=generator))
        field = field.map(lambda value: value.to(device))
        cotangent = torch.randn(queries, count, 3, generator=generator).to(device)
        weights = list(network.parameters())
        keys = list(range(4, 4 + queries))

        def offsets(network=network, field=field, keys=keys) -> Tensor:
            return network.at_keys(network.bind(field), keys).offset

        def both(offsets=offsets, weights=weights, cotangent=cotangent) -> object:
            return torch.autograd.grad(offsets(), weights, cotangent)

        measured = both_ways(both, watch, runs)
        best = (measured["graph"] or measured["eager"])["median"]
        row = {"N": count, "queries": queries, "products": products, "forward_backward": measured}
        forward = both_ways(torch.no_grad()(offsets), watch, runs)
        rows.append(row | {"forward": forward, "ms_per_query": best / queries})
        report(done, len(cases), N=count, ms=best)
    return rows


def products_of(kind: str) -> Products:
    """The setting of a row."""
    return Products.HALF if kind == BY_TORCH else Products(kind)


def set_backend(network: Network, kind: str) -> None:
    """Select the backend of training on this device, or cuBLAS."""
    if kind == BY_TORCH:
        network.backend = HalfPrecision(CublasLayers(), Form.of(network))
    else:
        with_backend(network)


def kinds(device: str) -> list[str]:
    """Rows of one case: every precision, and half by cuBLAS where the device has our kernels."""
    times = torch.arange(KEYS, dtype=torch.float64) * PERIOD_S
    form = Form.of(Network(times, MotionSettings(), duration=1.0, length=LENGTH_M))
    fused = fits(form, torch.empty(0, device=device).device)
    return [*map(str, Products), *[BY_TORCH] * fused]


def points(mean: Float[Tensor, "N 3"]) -> GaussianField:
    """Gaussians at given positions [m]; other parameters are arbitrary."""
    count = len(mean)
    return GaussianField(
        mean=mean,
        log_scale=torch.zeros(count, 3),
        quaternion=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        opacity_logit=torch.zeros(count),
        reflectivity_sh=constant_sh(torch.ones(count)),
    )


def table(rows: list[dict[str, Any]]) -> list[str]:
    """One line per row."""
    ways = ["forward, graph", "with backward", "called", "with backward"]
    heads = ["precision", "N", "queries", *ways, "per query"]
    cells = [
        [
            row["products"],
            f"{row['N']:,}",
            str(row["queries"]),
            *two_passes(row),
            f"{row['ms_per_query']:.3f}",
        ]
        for row in rows
    ]
    return lines_of("motion network, 8 layers of 256: median (10 .. 90 %) [ms]", heads, cells)
