"""All layers of a perceptron in one launch, forward and backward; formulas: render/layers.py.

``wgmma.py`` has the passes. Here weights are rounded and packed in the order in which tensor cores
read them, and the contribution of gamma(t) is added to the biases.
"""

import warp as wp

from .wgmma import BLOCK, PART, SHARED, TILE, VALUES, WIDTH, listed_backward, rows_forward

UNIT = wp.constant(8)  # halves of 16 bytes
_FOURS = wp.constant(SHARED // 16)


def mask_words(layers: int, keys: int, count: int) -> int:
    """Words of 32 bits for what is above 0: a thread has four of a tile."""
    return layers * keys * -(-count // TILE) * 128 * 4


@wp.struct
class Layers:
    """Sizes of a perceptron; parameters are one array, weight and bias of each layer in order."""

    layers: int  # without the head
    joined: int  # number of the last layer that gamma(x) and gamma(t) enter, as the first one
    position: int  # values of gamma(x)
    time: int  # values of gamma(t)


@wp.func
def enters(form: Layers, number: int) -> bool:
    """Whether gamma(x) and gamma(t) enter a layer."""
    return number == 0 or number == form.joined


@wp.func
def inputs_of(form: Layers, number: int) -> int:
    """Inputs of a layer."""
    inputs = WIDTH
    if number == 0:
        inputs = 0
    if enters(form, number):
        inputs += form.position + form.time
    return inputs


@wp.func
def weight_of(form: Layers, number: int) -> int:
    """Where the weight of a layer begins."""
    at = number * (WIDTH * WIDTH + WIDTH)
    if number > 0:
        at += WIDTH * (form.position + form.time - WIDTH)
    if form.joined > 0 and number > form.joined:
        at += WIDTH * (form.position + form.time)
    return at


@wp.func
def shift_of(
    form: Layers,
    parameters: wp.array[float],
    time: wp.array2d[float],
    number: int,
    key: int,
    n: int,
) -> float:
    """Bias of output ``n`` of a layer at a key, with the contribution of gamma(t)."""
    inputs = inputs_of(form, number)
    at = weight_of(form, number)
    total = parameters[at + inputs * WIDTH + n]
    if enters(form, number):
        row = at + (n + 1) * inputs - form.time
        for k in range(form.time):
            total += parameters[row + k] * time[key, k]
    return total


@wp.kernel(enable_backward=False)
def pack(
    # In:
    form: Layers,  # sizes [1]
    parameters: wp.array[float],  # [P] of all layers and the head
    time: wp.array2d[float],  # [k, t] gamma(t)
    # Out:
    forth: wp.array[wp.float16],  # [4 PART ..] of all layers
    back: wp.array[wp.float16],  # [4 PART ..] transposed, from the last layer to the second
    head: wp.array[wp.float16],  # [HEAD WIDTH] of the head, row by row, zeros below
    shifts: wp.array3d[float],  # [layers, k, WIDTH] what is added to every row of a key in a layer
):
    """Round and pack weights, a thread per 16 bytes; then compute shifts, a thread for each.

    A block of 64 inputs has a row of 128 bytes per output, swizzled in units of 16 bytes by the
    last three bits of its number. ``p`` and ``k`` are output and input of a packed position.
    """
    at = wp.tid() * UNIT
    if at >= forth.shape[0] + back.shape[0] + head.shape[0]:
        shift = (at - forth.shape[0] - back.shape[0] - head.shape[0]) // UNIT
        n = shift % WIDTH
        key = shift // WIDTH % time.shape[0]
        number = shift // (WIDTH * time.shape[0])
        shifts[number, key, n] = shift_of(form, parameters, time, number, key, n)
        return
    if at >= forth.shape[0] + back.shape[0]:
        at -= forth.shape[0] + back.shape[0]
        begin = weight_of(form, form.layers)
        for i in range(UNIT):
            value = float(0.0)
            if at + i < wp.static(VALUES * WIDTH):
                value = parameters[begin + at + i]
            head[at + i] = wp.float16(value)
        return
    backward = at >= forth.shape[0]
    if backward:
        at -= forth.shape[0]
    part = at // PART
    n = at % PART // 64
    u = (at % 64 // UNIT) ^ (n & 7)
    p = n // 32 * 32 + n % 8 // 2 * 8 + n % 32 // 8 * 2 + n % 2
    k = u // 4 * 32 + u // 2 % 2 * 4 + u % 2 * 2
    if backward:
        number = form.layers - 1 - part // 4
        k += part % 4 * 64
    else:
        number = int(0)
        while number + 1 < form.layers and first_part(form, number + 1) <= part:
            number += 1
        k += (part - first_part(form, number)) * 64
    begin = weight_of(form, number)
    stride = inputs_of(form, number)
    for i in range(UNIT):
        input = k + i // 2 * 8 + i % 2
        if backward:
            back[at + i] = wp.float16(parameters[begin + input * stride + p])
        else:
            forth[at + i] = wp.float16(parameters[begin + p * stride + input])


@wp.func
def first_part(form: Layers, number: int) -> int:
    """Blocks of weights before those of a layer."""
    parts = 4 * number
    if number > 0:
        parts -= 3
    if form.joined > 0 and number > form.joined:
        parts += 1
    return parts


@wp.kernel(enable_backward=False, grid_stride=False, launch_bounds=(BLOCK, 1), module="unique")
def forward(
    # In:
    form: Layers,  # sizes [1]
    keys: int,  # how many [1]
    position: wp.array2d[wp.float16],  # [N, COLUMNS] gamma(x)
    forth: wp.array[wp.float16],  # [4 PART ..] of ``pack``
    shifts: wp.array3d[float],  # [layers, k, WIDTH]
    # Out:
    outputs: wp.array3d[wp.float16],  # [layers, k N, WIDTH] of every layer
    masks: wp.array[wp.int32],  # [``mask_words``] bits of outputs above 0, per lane; on CUDA
):
    """From gamma(x) to the output of the last layer, at all keys."""
    # how Warp is told of shared memory
    wp.tile_zeros(shape=(_FOURS,), dtype=wp.vec4, storage="shared")
    rows_forward(
        form.layers, form.joined, keys, position.shape[0], position, forth, shifts, outputs, masks
    )


@wp.kernel(enable_backward=False, grid_stride=False, launch_bounds=(BLOCK, 1), module="unique")
def backward(
    # In:
    form: Layers,  # sizes [1]
    keys: int,  # how many [1]
    listed: wp.array[wp.int32],  # [capacity] of ``rows.list_rows``
    begins: wp.array[wp.int32],  # [k + 1] the same
    after: wp.array2d[wp.float16],  # [k N, HEAD] gradient at the head
    head: wp.array2d[float],  # [VALUES, WIDTH] its weight
    back: wp.array[wp.float16],  # [4 PART ..] of ``pack``
    outputs: wp.array3d[wp.float16],  # [layers, k N, WIDTH] of ``forward``
    masks: wp.array[wp.int32],  # [``mask_words``] of ``forward``
    # Out:
    slopes: wp.array3d[wp.float16],  # [layers, capacity, WIDTH] of the listed rows; 0 for padding
    partials: wp.array4d[float],  # [layers, k, GROUPS blocks, WIDTH] added to: sums over rows
):
    """Gradients of all layers for the listed rows; nothing is written behind the last one."""
    wp.tile_zeros(shape=(_FOURS,), dtype=wp.vec4, storage="shared")
    rows = outputs.shape[1] // keys
    listed_backward(
        form.layers,
        form.joined,
        keys,
        rows,
        listed,
        begins,
        after,
        head,
        back,
        outputs,
        masks,
        slopes,
        partials,
    )
