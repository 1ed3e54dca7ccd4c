"""Launches of a training step that are no rendering. Warp arrays in, Warp arrays filled; knows no torch."""

from __future__ import annotations

import warp as wp

from ..kernels.training import adam, image_similarity, noise, optical_flow, ordered_sums, step_end

BLOCK = 16  # pixels of a row, or elements of a tensor, that one CPU thread works on


def image_loss(
    rendered: wp.array,
    measured: wp.array,
    row: wp.array,
    also: wp.array,
    share: float,
    absolute: bool,
    columns: wp.array,
    partials: wp.array,
    slopes: wp.array,
    out: wp.array,
) -> None:
    """Fill ``out`` [3] with the means of loss, squared difference and another image, ``slopes`` for the gradient.

    Args:
        rendered: [C, H, W].
        measured: [R C, H, W].
        row: [1] which C of them.
        also: [H W], or empty; the mean is over the number of values of ``rendered``.
        share: Of the similarity, 0..1.
        absolute: Whether the other part is the absolute difference, otherwise its square.
        columns: [5, C, H, W + 10], margins zero; scratch.
        partials: [3, ``loss_parts(rendered)``]; scratch.
        slopes: [3, C, H, W + 10], margins zero; filled.
        out: Filled.
    """
    kernels, dim = _of(rendered)
    _launch(kernels.columns_of_products, dim, [rendered, measured, row], [columns])
    inputs = [columns, rendered, measured, row, also, share, absolute]
    _launch(kernels.compare_images, _whole_warps(dim[0] * dim[1] * dim[2], rendered.device), inputs, [partials, slopes])
    _means(partials, 1.0 / rendered.size, out)


def loss_parts(rendered: wp.array) -> int:
    """Partial sums of an image [C, H, W]."""
    _, (channels, height, blocks) = _of(rendered)
    return _parts(channels * height * blocks, rendered.device)


def image_loss_backward(
    rendered: wp.array,
    measured: wp.array,
    row: wp.array,
    share: float,
    absolute: bool,
    slopes: wp.array,
    cotangent: wp.array,
    columns: wp.array,
    grad: wp.array,
) -> None:
    """Fill ``grad`` [C, H, W] with the gradient of the mean loss times ``cotangent`` [1]; ``columns`` is scratch."""
    kernels, dim = _of(rendered)
    _launch(kernels.columns_of_slopes, dim, [slopes], [columns])
    inputs = [columns, rendered, measured, row, share, absolute, 1.0 / rendered.size, cotangent]
    _launch(kernels.gradient_of_image, dim, inputs, [grad])


def flow_loss(
    distance: wp.array,
    displacement: wp.array,
    measured: wp.array,
    row: wp.array,
    views: wp.array,
    partials: wp.array,
    out: wp.array,
) -> None:
    """Fill ``out`` [1] with the sum over F flows of the mean squared difference; see optical_flow.py.

    Args:
        distance: [H, W].
        displacement: [3F, H, W].
        measured: [R F, 2, H, W].
        row: [1] which F of them.
        views: [F, 29 or 40] cameras.
        partials: [1, ``flow_parts(distance)``]; scratch.
        out: Filled.
    """
    inputs = [distance, displacement, measured, row, views]
    _launch(optical_flow.flow_errors, _whole_warps(distance.size, distance.device), inputs, [partials])
    _means(partials, 0.5 / distance.size, out)


def flow_parts(distance: wp.array) -> int:
    """Partial sums of an image [H, W]."""
    return _parts(distance.size, distance.device)


def flow_loss_backward(
    distance: wp.array,
    displacement: wp.array,
    measured: wp.array,
    row: wp.array,
    views: wp.array,
    cotangent: wp.array,
    grad: wp.array,
) -> None:
    """Fill ``grad`` [3F, H, W] with the gradient by ``displacement`` times ``cotangent`` [1]."""
    inputs = [distance, displacement, measured, row, views, 0.5 / distance.size, cotangent]
    _launch(optical_flow.flow_gradient, (views.shape[0], distance.size), inputs, [grad])


def _means(partials: wp.array, scale: float, out: wp.array) -> None:
    """Rows of partial sums, added up and scaled."""
    threads = 1 if partials.device.is_cpu else ordered_sums.THREADS
    dim = partials.shape[0] * threads
    _launch(ordered_sums.means, dim, [partials, threads, scale], [out], block_dim=ordered_sums.THREADS)


def _whole_warps(count: int, device: wp.Device) -> int:
    """Threads for ``count`` elements, all lanes of the last warp included."""
    return count if device.is_cpu else -(-count // ordered_sums.LANES) * ordered_sums.LANES


def _parts(count: int, device: wp.Device) -> int:
    """Partial sums of so many threads: one per warp, on the CPU one per thread."""
    return count if device.is_cpu else -(-count // ordered_sums.LANES)


def _of(image: wp.array):
    """Kernels for an image [C, H, W], and how many threads they want."""
    channels, height, width = image.shape
    block = BLOCK if image.device.is_cpu and width >= BLOCK else 1
    return image_similarity.make_similarity(block), (channels, height, -(-width // block))


def uniform(origin: wp.array, stream: int, amplitude: float, image: wp.array) -> None:
    """Fill ``image`` [C, pixels] with values in (-amplitude, amplitude) for ``origin`` [2], seed and image number."""
    channels, pixels = image.shape
    dim = channels, -(-pixels // noise.PER_THREAD)
    inputs = [origin, stream, amplitude]
    _launch(noise.uniform_noise, dim, inputs, [image])


def added(arrays: list[wp.array], total: wp.array) -> None:
    """Fill ``total`` with the sum of one to four arrays, in their order."""
    _launch(ordered_sums.add_up, len(total), [*_four(arrays), len(arrays)], [total])


def adam_step(
    table: wp.array, first_block: wp.array, blocks: int, betas: tuple[float, float], epsilon: float, sizes: wp.array
) -> None:
    """One step of Adam over the tensors of a table, in place.

    Args:
        table: [T, 9] addresses and lengths, see ``kernels/training/adam.py``.
        first_block: [T] blocks before those of a tensor.
        blocks: In all, each of ``adam_block`` elements.
        betas: Decays of the moments.
        epsilon: Added to the root of the second moment.
        sizes: [T, 3] step sizes from :func:`finish_step`.
    """
    rest = [table, first_block, 1.0 - betas[0], 1.0 - betas[1], epsilon]
    _launch(adam.make_adam(adam_block(table.device)), blocks, rest, [sizes])


def finish_step(
    table: wp.array,
    first_part: wp.array,
    partials: wp.array,
    motion: tuple[int, int],
    gradient_max: float | None,
    results: tuple[wp.array, wp.array, int, wp.array],
    pairs: tuple[wp.array, int, int | None],
    rates: wp.array,
    betas: tuple[float, float],
    outputs: tuple[wp.array, wp.array, wp.array],
) -> None:
    """Squares of all gradients, and whether the step is valid; see ``kernels/training/step_end.py``.

    Args:
        table: [T, 9] of Adam.
        first_part: [T] parts before those of a tensor.
        partials: [P] scratch.
        motion: Parts and tensors before those of the motion.
        gradient_max: Largest gradient norm of the motion; None: any.
        results: [B or more, 3 L] results, their weights, B, and [1] images with any term.
        pairs: [R or more] of every rendering, R, and those with memory; None: all.
        rates: [T].
        betas: Decays of the moments.
        outputs: [4] counts and [L + 4] sums, changed, and [T, 3] step sizes, filled.
    """
    cpu = table.device.is_cpu
    dim = len(partials) * (1 if cpu else ordered_sums.LANES)
    _launch(step_end.gradient_squares, dim, [table, first_part], [partials])
    used, renderings, capacity = pairs
    head = [partials, *motion, gradient_max is not None, gradient_max or 0.0, *results]
    limits = [used, renderings, capacity is not None, capacity or 0]
    rest = [table, rates, *(wp.float64(beta) for beta in betas)]
    threads = 1 if cpu else step_end.THREADS
    inputs = head + limits + rest
    _launch(step_end.finish_step, threads, inputs, [*outputs], block_dim=step_end.THREADS)


def add_statistics(screens: list[wp.array], half: tuple[float, float], counts: wp.array, sums: list[wp.array]) -> None:
    """Add one to four images [N, 4] to gradients, pixels and weights [N], if ``counts[1]`` is 0."""
    inputs = [*_four(screens), len(screens), wp.vec2(*half), counts]
    _launch(step_end.add_statistics, len(sums[0]), inputs, sums)


def _four(arrays: list[wp.array]) -> list[wp.array]:
    return arrays + [arrays[0]] * (4 - len(arrays))


def adam_block(device: wp.Device) -> int:
    """Elements that one thread of Adam works on."""
    return BLOCK if device.is_cpu else 1


def _launch(kernel, dim, inputs: list, outputs: list[wp.array], block_dim: int = 256) -> None:
    device = outputs[0].device
    wp.launch(kernel, dim, inputs, outputs, device=device, record_tape=False, block_dim=block_dim)
