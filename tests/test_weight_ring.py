"""Who may overwrite weights in the ring of wgmma.py: a model of its two groups, in any order of
their steps.

Only a GPU runs the kernel; what this checks is the rule of ``release``: a group that has no tile
says of all layers at once that it needs their weights no more, and must not be taken for the other
one.
"""

import random

import pytest

from gftorf_warp.kernels.network.wgmma import ROUND, SLOTS

PUBLISHED = (1, 4, 4, 4, 4, 5, 4, 4)  # blocks of weights of each layer, forward
BACK = (4,) * 7
STUCK = 3000  # steps in a row in which nothing happens


class Ring:
    """Slots, what is on its way to them and how often each was filled."""

    def __init__(self):
        self.content: list[int | None] = [None] * SLOTS
        self.coming: list[int | None] = [None] * SLOTS
        self.phases = [0] * SLOTS
        self.read: list[set[int]] = [set(), set()]
        self.sent: list[int] = []

    def send(self, block):
        """Ask for a block."""
        slot = block % SLOTS
        assert self.coming[slot] is None, "two blocks are on their way to one slot"
        assert all(other % SLOTS != slot for group in self.read for other in group), (
            "weights in use are overwritten"
        )
        self.coming[slot] = block
        self.sent.append(block)

    def arrive(self, slot):
        """What was asked for is there."""
        self.content[slot], self.coming[slot] = self.coming[slot], None
        self.phases[slot] += 1

    def there(self, block):
        """Whether a block has come, as far as one bit of its slot's phase tells."""
        return (self.phases[block % SLOTS] ^ block // SLOTS) & 1


def group(me, layers, rounds, ring, counts, total):
    """The steps of a group of warps; yields False where it waits."""
    done = finished = 0

    def release(blocks):
        nonlocal done, finished
        sent, done, finished = min(done + SLOTS, total), done + blocks, finished + 1
        of_other, counts[me] = counts[1 - me], counts[me] + 1  # one atomic addition
        yield True
        if of_other >= finished:
            for block in range(sent, min(done + SLOTS, total)):
                ring.send(block)
                yield True

    for begin, end in rounds:
        for blocks in layers:
            if begin + me >= end:
                yield from release(blocks)
            for tile in range(begin + me, end, 2):
                for block in range(done, done + blocks):
                    while not ring.there(block):
                        yield False
                    assert ring.content[block % SLOTS] == block, "weights of another layer"
                    ring.read[me].add(block)
                    yield True
                ring.read[me].clear()
                if tile + 2 >= end:
                    yield from release(blocks)
                yield True


@pytest.mark.parametrize("layers", [PUBLISHED, BACK, (1,), (1, 4)], ids=str)
@pytest.mark.parametrize("tiles", [1, 2, 3, ROUND, ROUND + 1, ROUND + 2, 2 * ROUND + 1])
def test_every_block_comes_once_and_in_time(tiles, layers):
    """No slot is filled while a group reads it, no group waits for ever,
    and all blocks come in their order.
    """
    rounds = [(begin, min(begin + ROUND, tiles)) for begin in range(0, tiles, ROUND)]
    total = sum(layers) * len(rounds)
    for seed in range(20):
        draw, ring, counts = random.Random(seed), Ring(), [0, 0]
        for block in range(min(SLOTS, total)):
            ring.send(block)
        running = {me: group(me, layers, rounds, ring, counts, total) for me in (0, 1)}
        hurry, idle = draw.random(), 0
        while running:
            moved = False
            for slot in range(SLOTS):
                if ring.coming[slot] is not None and draw.random() < 0.3:
                    ring.arrive(slot)
                    moved = True
            me = int(draw.random() < hurry) if draw.random() < 0.5 else draw.choice(list(running))
            if me in running:
                try:
                    moved |= next(running[me])
                except StopIteration:
                    del running[me]
                    moved = True
            idle = 0 if moved else idle + 1
            assert idle < STUCK, "both groups wait"
        assert ring.sent == list(range(total))
