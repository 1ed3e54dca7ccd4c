"""Room for pairs: enough before it is needed, and not given up for a moment."""

from gftorf_warp.recon.reserve import ASK_EVERY, FULL, PAIRS, PATIENCE, Reserve
from gftorf_warp.render.bridge import SLOTS


def test_it_grows_before_it_is_full():
    """At eight tenths, which the steps on their way do not fill."""
    reserve = Reserve()
    assert not reserve.is_nearly_full(10**9), "nothing is known: pairs are counted first"
    assert not reserve.learn(0, scarce=True)
    assert reserve.learn(1_000_000, scarce=True)
    assert 1_500_000 <= reserve.capacity < 1_500_000 + PAIRS
    assert not reserve.learn(1_100_000, scarce=True)
    assert not reserve.is_nearly_full(1_100_000)
    assert reserve.is_nearly_full(1_300_000)
    assert reserve.learn(1_300_000, scarce=True)
    assert reserve.capacity >= 1_950_000


def test_what_grows_after_a_reset_never_fills_it():
    """All opacities grow at once then, pairs by half within 30 steps; numbers are up to sixteen steps old.

    So many steps lie between two questions and between host and device, together. Growth that went on at this rate
    would leave room for all of them, but not for a few more.
    """
    assert FULL * 1.5 ** ((ASK_EVERY + SLOTS) / 30) <= 1 < FULL * 1.5 ** ((ASK_EVERY + SLOTS + 1) / 30)
    for late in range(ASK_EVERY + SLOTS + 1):
        reserve, pairs = Reserve(), [1_360_000]
        reserve.learn(pairs[0], scarce=True)
        for step in range(1, 60):
            pairs.append(int(1_360_000 * 1.5 ** min(step / 30, 1)))
            assert pairs[-1] <= reserve.capacity, (late, step)
            if reserve.is_nearly_full(pairs[max(step - late, 0)]):
                reserve.learn(pairs[-1], scarce=True)  # waits for the newest


def test_room_that_costs_nothing_is_given_up_late():
    """Three times as much, for as long as a twentieth of it is used."""
    reserve = Reserve()
    reserve.learn(1_000_000, scarce=False)
    assert 3_000_000 <= reserve.capacity < 3_000_000 + PAIRS
    assert not any(reserve.learn(pairs, scarce=False) for pairs in [2_300_000, *([160_000] * 20), 2_300_000])
    assert reserve.learn(2_500_000, scarce=False)
    assert [reserve.learn(1_000, scarce=False) for _ in range(PATIENCE + 1)] == [False] * PATIENCE + [True]


def test_it_shrinks_only_if_it_stays_empty():
    """A reset of the opacities leaves few pairs for some hundred images, and more than before after that."""
    reserve = Reserve()
    reserve.learn(1_000_000, scarce=True)
    for _ in range(PATIENCE):
        assert not reserve.learn(100_000, scarce=True)
    assert not reserve.learn(900_000, scarce=True)
    for _ in range(PATIENCE):
        assert not reserve.learn(100_000, scarce=True)
    assert reserve.learn(100_000, scarce=True)
    assert reserve.capacity < 300_000
