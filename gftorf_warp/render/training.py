"""Launches of a training step that are no rendering. Warp arrays in, Warp arrays filled; knows no torch."""

from __future__ import annotations

import warp as wp

from ..kernels import adam, noise, similarity

BLOCK = 16  # pixels of a row, or elements of a tensor, that one CPU thread works on


def image_loss(
    rendered: wp.array, measured: wp.array, share: float, absolute: bool, columns: wp.array, maps: wp.array, slopes
) -> None:
    """Fill ``maps`` [2, C, H, W] with loss and squared difference, and ``slopes`` with what the gradient needs.

    Args:
        rendered: [C, H, W].
        measured: [C, H, W].
        share: Of the similarity, 0..1.
        absolute: Whether the other part is the absolute difference, otherwise its square.
        columns: [5, C, H, W + 10], margins zero; scratch.
        maps: Filled.
        slopes: [3, C, H, W + 10], margins zero; filled.
    """
    kernels, dim = _of(rendered)
    wp.launch(
        kernels.columns_of_products, dim, [rendered, measured], [columns], device=rendered.device, record_tape=False
    )
    inputs = [columns, rendered, measured, share, absolute]
    _launch(kernels.compare_images, dim, inputs, [maps, slopes])


def image_loss_backward(
    rendered: wp.array,
    measured: wp.array,
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
    inputs = [columns, rendered, measured, share, absolute, 1.0 / rendered.size, cotangent]
    _launch(kernels.gradient_of_image, dim, inputs, [grad])


def _of(image: wp.array):
    """Kernels for an image [C, H, W], and how many threads they want."""
    channels, height, width = image.shape
    block = BLOCK if image.device.is_cpu and width >= BLOCK else 1
    return similarity.make_similarity(block), (channels, height, -(-width // block))


def uniform(origin: wp.array, stream: int, amplitude: float, image: wp.array) -> None:
    """Fill ``image`` [C, pixels] with values in (-amplitude, amplitude) for ``origin`` [2], seed and image number."""
    channels, pixels = image.shape
    dim = channels, -(-pixels // noise.PER_THREAD)
    inputs = [origin, stream, amplitude]
    _launch(noise.uniform_noise, dim, inputs, [image])


def adam_step(
    table: wp.array,
    first_block: wp.array,
    blocks: int,
    rates: wp.array,
    sound: wp.array,
    betas: tuple[float, float],
    epsilon: float,
    sizes: wp.array,
) -> None:
    """One step of Adam over the tensors of a table, in place; ``sizes`` [T, 2] is scratch.

    Args:
        table: [T, 6] addresses and lengths, see ``kernels/adam.py``.
        first_block: [T] blocks before those of a tensor.
        blocks: In all, each of ``adam_block`` elements.
        rates: [T] 0: the tensor rests.
        sound: [1] 0: nothing changes.
        betas: Decays of the moments.
        epsilon: Added to the root of the second moment.
        sizes: Scratch.
    """
    head = [table, rates, sound, *(wp.float64(beta) for beta in betas)]
    _launch(adam.adam_sizes, table.shape[0], head, [sizes])
    rest = [table, first_block, 1.0 - betas[0], 1.0 - betas[1], epsilon]
    _launch(adam.make_adam(adam_block(table.device)), blocks, rest, [sizes])


def adam_block(device: wp.Device) -> int:
    """Elements that one thread of Adam works on."""
    return BLOCK if device.is_cpu else 1


def _launch(kernel, dim, inputs: list, outputs: list[wp.array]) -> None:
    wp.launch(kernel, dim, inputs, outputs, device=outputs[0].device, record_tape=False)
