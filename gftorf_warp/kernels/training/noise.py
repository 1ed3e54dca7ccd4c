"""Random light by a counter-based generator: a function of seed, image, stream, channel and pixel.

Philox 4x32 with ten rounds (Salmon et al., Parallel Random Numbers: As Easy as 1, 2, 3, 2011) turns
the counter (block of four pixels, channel, image, stream) and the key (seed, 0) into four words,
one per pixel. There is no state to store; a replayed graph reads seed and image from memory.
"""

import warp as wp

ROUNDS = wp.constant(10)
MULTIPLIER_0 = wp.constant(wp.uint64(0xD2511F53))
MULTIPLIER_1 = wp.constant(wp.uint64(0xCD9E8D57))
WEYL_0 = wp.constant(wp.uint32(0x9E3779B9))  # golden ratio
WEYL_1 = wp.constant(wp.uint32(0xBB67AE85))  # sqrt(3) - 1
PER_THREAD = 4  # words of one call
_SHIFT = wp.constant(wp.uint64(32))
_SPARE_BITS = wp.constant(wp.uint32(9))
# 23 bits and a half fit a float32 exactly, so that values lie evenly about zero
STEP = wp.constant(2.0**-23)

Words = wp.types.vector(length=4, dtype=wp.uint32)


@wp.func
def philox(counter: Words, key_0: wp.uint32, key_1: wp.uint32) -> Words:
    """Four random words."""
    word = counter
    k0 = key_0
    k1 = key_1
    for _ in range(ROUNDS):
        product_0 = MULTIPLIER_0 * wp.uint64(word[0])
        product_1 = MULTIPLIER_1 * wp.uint64(word[2])
        high_0 = wp.uint32(product_0 >> _SHIFT)
        high_1 = wp.uint32(product_1 >> _SHIFT)
        word = Words(
            high_1 ^ word[1] ^ k0, wp.uint32(product_1), high_0 ^ word[3] ^ k1, wp.uint32(product_0)
        )
        k0 = k0 + WEYL_0
        k1 = k1 + WEYL_1
    return word


@wp.kernel(enable_backward=False)
def uniform_noise(
    # In:
    origin: wp.array[int],  # [2] seed and number of the image [1]
    stream: int,  # tells images of one number apart, for example quads and colour [index]
    amplitude: float,  # values lie evenly in (-amplitude, amplitude) [quad units]
    # Out:
    image: wp.array2d[float],  # [C, pixels]
):
    """One thread per channel and four pixels."""
    channel, block = wp.tid()
    counter = Words(wp.uint32(block), wp.uint32(channel), wp.uint32(origin[1]), wp.uint32(stream))
    word = philox(counter, wp.uint32(origin[0]), wp.uint32(0))
    for lane in range(4):
        pixel = 4 * block + lane
        if pixel < image.shape[1]:
            share = (float(word[lane] >> _SPARE_BITS) + 0.5) * STEP
            image[channel, pixel] = amplitude * (2.0 * share - 1.0)
