"""The order of few splats by depth key without a sort: classes of keys are counted, and who is in one is compared.

A radix sort of 20,000 keys takes a pass over all of them for every eight bits, each of which waits for the one before.
Here a class is the highest bits of a key. Where its splats go is a sum over the classes before it; among themselves
every splat counts those in front of it: those of a smaller key, or of an equal one and a smaller index, which is one
comparison of both in 64 bits. What is culled is one class more, in which nobody asks for an order.
"""

import warp as wp

CLASSES = 1 << 16  # of what is not culled: a wall that faces a camera is in few of them, which is what takes long
COUNTS = CLASSES + 2  # one more for what is culled, and the end


@wp.func
def class_of(key: int, culled: int, shift: int) -> int:
    """The class of a key; that of what is culled is behind all others."""
    number = key >> shift
    if key == culled:
        number = CLASSES
    return number


@wp.kernel(enable_backward=False)
def count_classes(
    # In:
    keys: wp.array[wp.int32],  # [>= N] of each splat
    culled: int,  # key of what is culled [1]
    shift: int,  # bits of a key that its class leaves out [1]
    # Out:
    counts: wp.array[int],  # [COUNTS] splats of the class before, added to
    places: wp.array[wp.int32],  # [N] of each splat in its class, in the order of arrival
):
    """A thread per splat."""
    n = wp.tid()
    places[n] = wp.atomic_add(counts, class_of(keys[n], culled, shift) + 1, 1)


@wp.kernel(enable_backward=False)
def fill_classes(
    # In:
    keys: wp.array[wp.int32],  # [>= N] of each splat
    culled: int,  # key of what is culled [1]
    shift: int,  # bits of a key that its class leaves out [1]
    first: wp.array[int],  # [COUNTS] where the splats of each class begin
    places: wp.array[wp.int32],  # [N] of each splat in its class
    # Out:
    members: wp.array[wp.int64],  # [N] key and index of every splat in the upper and the lower half, class by class
):
    """A thread per splat."""
    n = wp.tid()
    at = first[class_of(keys[n], culled, shift)] + places[n]
    members[at] = (wp.int64(keys[n]) << wp.int64(32)) | wp.int64(n)


@wp.kernel(enable_backward=False)
def order_classes(
    # In:
    members: wp.array[wp.int64],  # [N] key and index of every splat, class by class
    culled: int,  # key of what is culled [1]
    shift: int,  # bits of a key that its class leaves out [1]
    first: wp.array[int],  # [COUNTS] where the splats of each class begin
    # Out:
    order: wp.array[wp.int32],  # [>= N] splats near to far
):
    """A thread per splat, neighbours of one class."""
    at = wp.tid()
    own = members[at]
    key = int(own >> wp.int64(32))
    place = at
    if key != culled:
        number = class_of(key, culled, shift)
        place = first[number]
        for other in range(first[number], first[number + 1]):
            place += int(members[other] < own)
    order[place] = int(own & wp.int64(0xFFFFFFFF))
