"""Compile every kernel for a CUDA architecture, without a GPU or a driver, and print registers,
stack and code size.

    python benchmarks/compile_sm90.py [--arch 90] [--json FILE]

Ends with exit code 1 if a kernel does not compile or keeps more than 32 bytes on the stack: a local
array indexed at run time, or spilled registers, is how a fast kernel silently becomes a slow one
(sinf and cosf own 32 bytes that are never touched). The motion network's passes are compiled for
sm_90a, and left out for other architectures.
"""

from __future__ import annotations

import argparse
import itertools
import json
import struct
import sys
import tempfile
from pathlib import Path

import warp as wp

from gftorf_warp.kernels.meshing import signed_distance
from gftorf_warp.kernels.motion import displace, move
from gftorf_warp.kernels.network import (
    encoding,
    gradient_rows,
    gradient_scaling,
    parameter_gradients,
    perceptron,
    weight_gradients,
    wgmma,
)
from gftorf_warp.kernels.rasterise import (
    composite,
    composite_backward,
    depth_bins,
    planes_to_images,
    project,
    splat,
    splat_distance,
    tile_bitmask,
    tiles,
)
from gftorf_warp.kernels.tracing import light_paths, rays
from gftorf_warp.kernels.training import (
    adam,
    image_similarity,
    noise,
    optical_flow,
    ordered_sums,
    step_end,
)
from gftorf_warp.kernels.volume import hash_grid
from gftorf_warp.render.buffers import SEGMENTS, TILE_SHAPES

FRAME_SIZE, REGISTERS = 0x11, 0x2F  # attributes in the .nv.info section of a cubin
ALLOWED_STACK = 32  # [B]
PASSES = "perceptron forward", "perceptron backward"  # for sm_90a
# [B] a query of a bounding volume hierarchy keeps the nodes to come on the stack
HIERARCHIES = {"trace": 1024, "paths": 1024}


def modules(arch: int) -> dict[str, wp.Module]:
    """Every module with CUDA code that an architecture has, in the variants that presets use."""
    shape = TILE_SHAPES["cuda"]
    found = {
        "tiles": tiles.count_pairs.module,
        "bits": tile_bitmask.count_bits.module,
        "ranks": depth_bins.count_bins.module,
        "resolve": planes_to_images.resolve_quads.module,
        "splat": splat.add_records.module,
        "move": move.make_move(2).module,
        "note largest": move.note_largest.module,
        "noise": noise.uniform_noise.module,
        "adam": adam.make_adam(1).module,
        "encoding": encoding.encode.module,
        "finish": step_end.finish_step.module,
        "flow": optical_flow.flow_errors.module,
        "sums": ordered_sums.means.module,
        "trace": rays.trace_hits.module,
        "paths": light_paths.trace_light.module,
        "surface": signed_distance.fuse.module,
        "hash grid": hash_grid.interpolate.module,
        "perceptron": perceptron.pack.module,
        "slopes": gradient_scaling.add_partials.module,
        "rows": gradient_rows.list_rows.module,
        "gradients": parameter_gradients.collect.module,
        "weights of outputs": weight_gradients.multiply_outputs.module,
        "weights of positions": weight_gradients.multiply_positions.module,
    }
    if arch == wgmma.ARCHITECTURE:
        passes = perceptron.forward, perceptron.backward
        found |= {title: kernel.module for title, kernel in zip(PASSES, passes, strict=True)}
    for keys in (2, 3, 4):
        for name, kernel in vars(displace.make_displace(keys)).items():
            found[f"{name} {keys}"] = kernel.module
    window = image_similarity.make_similarity(1)
    for name in ("columns_of_products", "compare_images", "columns_of_slopes", "gradient_of_image"):
        found[name] = getattr(window, name).module
    found["finish_moments"] = composite_backward.finish_moments.module
    found["finish_slopes"] = splat_distance.finish_slopes.module
    for colour in (False, True):
        variants = (False, False), (True, False), (False, True)
        for (square, sloped), adjoint in itertools.product(variants, (False, True)):
            kernel = project.make_project(colour, square, sloped=sloped, adjoint=adjoint)
            title = "project" + " colour" * colour + " square" * square + " sloped" * sloped
            found[title + " adjoint" * adjoint] = kernel.module
    for sloped in (False, True):
        given = *shape, True, False, True, None, False, 1, sloped, True
        title = "composite light without median" + " sloped" * sloped
        found[title] = composite.make_composite(*given).module
    for adjoint in (False, True):
        kernel = project.make_project(False, False, True, True, adjoint)
        found["project sloped lens" + " adjoint" * adjoint] = kernel.module
    given = *shape, True, False, False, None, False, False, SEGMENTS["cuda"], True, True
    title = "composite_backward light without in segments sloped calibrated"
    found[title] = composite_backward.make_composite_backward(*given).module
    for light, channels, fixed in (
        (True, False, False), (True, True, False), (True, True, True), (False, True, False),
        (False, True, True),
    ):  # fmt: skip
        what = " ".join(["light"] * light + ["channels"] * channels + ["fixed"] * fixed)
        for metric in (True, False, None) if light else (None,):
            name = f"{what} {'without' if metric is None else 'paper' if metric else 'released'}"
            for more in {False, light and channels}:
                split = light and metric is None and (fixed or not channels)
                numbers = {1, SEGMENTS["cuda"] if split else 1}
                for segments, sloped in itertools.product(numbers, {False, light}):
                    given = *shape, light, channels, bool(metric), metric, more, segments, sloped
                    arguments = *shape, light, channels, not metric, metric, fixed, more, segments
                    title = name + " and three more" * more + " in segments" * (segments > 1)
                    title += " sloped" * sloped
                    if not fixed or segments > 1:
                        found[f"composite {title}"] = composite.make_composite(*given).module
                    found[f"composite_backward {title}"] = (
                        composite_backward.make_composite_backward(*arguments, sloped).module
                    )
    return found


def compiled(title: str, module: wp.Module, arch: int, folder: str) -> list[Path]:
    """Cubins of a module; those of ``PASSES`` with what only this architecture has."""
    before, wp.config.cuda_arch_suffix = (
        wp.config.cuda_arch_suffix,
        "a" if title in PASSES else None,
    )
    try:
        return [
            Path(path)
            for path in wp.compile_aot_module(module, arch=arch, module_dir=folder, use_ptx=False)
        ]
    finally:
        wp.config.cuda_arch_suffix = before


def kernels_in(cubin: Path) -> dict[str, tuple[int, int, int]]:
    """{kernel: (registers, stack bytes, code bytes)} of a cubin, which is a 64-bit ELF file."""
    data = cubin.read_bytes()
    (table,) = struct.unpack_from("<Q", data, 0x28)
    entry, count, names = struct.unpack_from("<HHH", data, 0x3A)
    headers = [struct.unpack_from("<IIQQQQIIQQ", data, table + i * entry) for i in range(count)]

    def text(at: int) -> str:
        return data[at : data.index(b"\0", at)].decode()

    # name, type, flags, address, offset, size, ...
    sections = {text(headers[names][4] + h[0]): h for h in headers}
    symbols, strings = sections[".symtab"][4], sections[".strtab"][4]
    found: dict[str, dict[int, int]] = {}
    at, end = sections[".nv.info"][4], sum(sections[".nv.info"][4:6])
    while at < end:
        form, attribute, size = struct.unpack_from("<BBH", data, at)
        if form == 4 and size == 8 and attribute in (FRAME_SIZE, REGISTERS):
            symbol, value = struct.unpack_from("<II", data, at + 4)
            (name,) = struct.unpack_from("<I", data, symbols + 24 * symbol)
            found.setdefault(text(strings + name), {})[attribute] = value
        at += 4 + (size if form == 4 else 0)
    return {
        name: (value.get(REGISTERS, 0), value.get(FRAME_SIZE, 0), sections[".text." + name][5])
        for name, value in found.items()
        if ".text." + name in sections
    }


def main() -> int:
    """Print the table, write the JSON, judge the stack."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--arch", type=int, default=90, help="compute capability, 90 is H100 and H200"
    )
    parser.add_argument("--json", type=Path)
    a = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    wp.init()
    rows, offenders = [], 0
    for title, module in modules(a.arch).items():
        with tempfile.TemporaryDirectory() as folder:
            for path in compiled(title, module, a.arch, folder):
                for name, (registers, stack, code) in kernels_in(path).items():
                    kernel, _, way = name.partition("_cuda_kernel_")
                    kernel = kernel.rpartition("__locals__")[2].rpartition("_")[0]
                    rows.append(
                        {
                            "module": title,
                            "kernel": f"{kernel} {way}",
                            "registers": registers,
                            "stack": stack,
                        }
                    )
                    offenders += stack > HIERARCHIES.get(title, ALLOWED_STACK)
                    use = f"{registers:4d} registers {stack:4d} B stack {code:6d} B code"
                    print(f"sm_{a.arch} {title:<38} {kernel:<20} {way:<9}{use}")
    if a.json:
        a.json.write_text(
            json.dumps({"arch": a.arch, "warp": wp.__version__, "kernels": rows}, indent=1) + "\n"
        )
    print(
        f"{len(rows)} kernels, {offenders} with more than {ALLOWED_STACK} B of stack "
        f"({HIERARCHIES})"
    )
    return int(offenders > 0 or not rows)


if __name__ == "__main__":
    sys.exit(main())
