"""The pair capacity grows before it is exceeded, and does not shrink for a moment."""

from gftorf_warp.render.cuda import SLOTS
from gftorf_warp.render.pair_capacity import FULL, PATIENCE, READ_EVERY, ROUNDED_TO, PairCapacity


def test_it_grows_before_it_is_full():
    """At eight tenths, which the steps on their way do not fill."""
    capacity = PairCapacity()
    assert not capacity.is_nearly_full(10**9), "nothing is known: pairs are counted first"
    assert not capacity.learn(0, is_sorted=True)
    assert capacity.learn(1_000_000, is_sorted=True)
    assert 1_500_000 <= capacity.pairs < 1_500_000 + ROUNDED_TO
    assert not capacity.learn(1_100_000, is_sorted=True)
    assert not capacity.is_nearly_full(1_100_000)
    assert capacity.is_nearly_full(1_300_000)
    assert capacity.learn(1_300_000, is_sorted=True)
    assert capacity.pairs >= 1_950_000


def test_what_grows_after_a_reset_never_fills_it():
    """All opacities grow at once then, pairs by half within 30 steps; numbers are up to sixteen
    steps old.

    So many steps lie between two questions and between host and device, together. Growth that went
    on at this rate would leave room for all of them, but not for a few more.
    """
    assert (
        FULL * 1.5 ** ((READ_EVERY + SLOTS) / 30)
        <= 1
        < FULL * 1.5 ** ((READ_EVERY + SLOTS + 1) / 30)
    )
    for late in range(READ_EVERY + SLOTS + 1):
        capacity, pairs = PairCapacity(), [1_360_000]
        capacity.learn(pairs[0], is_sorted=True)
        for step in range(1, 60):
            pairs.append(int(1_360_000 * 1.5 ** min(step / 30, 1)))
            assert pairs[-1] <= capacity.pairs, (late, step)
            if capacity.is_nearly_full(pairs[max(step - late, 0)]):
                capacity.learn(pairs[-1], is_sorted=True)  # waits for the newest


def test_room_that_costs_nothing_is_given_up_late():
    """Three times as much, for as long as a twentieth of it is used."""
    capacity = PairCapacity()
    capacity.learn(1_000_000, is_sorted=False)
    assert 3_000_000 <= capacity.pairs < 3_000_000 + ROUNDED_TO
    assert not any(
        capacity.learn(pairs, is_sorted=False)
        for pairs in [2_300_000, *([160_000] * 20), 2_300_000]
    )
    assert capacity.learn(2_500_000, is_sorted=False)
    assert [capacity.learn(1_000, is_sorted=False) for _ in range(PATIENCE + 1)] == [
        False
    ] * PATIENCE + [True]


def test_it_shrinks_only_if_it_stays_empty():
    """A reset of the opacities leaves few pairs for some hundred images,
    and more than before after that.
    """
    capacity = PairCapacity()
    capacity.learn(1_000_000, is_sorted=True)
    for _ in range(PATIENCE):
        assert not capacity.learn(100_000, is_sorted=True)
    assert not capacity.learn(900_000, is_sorted=True)
    for _ in range(PATIENCE):
        assert not capacity.learn(100_000, is_sorted=True)
    assert capacity.learn(100_000, is_sorted=True)
    assert capacity.pairs < 300_000
