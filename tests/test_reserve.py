"""Room for pairs: enough before it is needed, and not given up for a moment."""

from gftorf_warp.recon.reserve import PAIRS, PATIENCE, Reserve


def test_it_grows_before_it_is_full():
    """At eight tenths, which the steps on their way do not fill."""
    reserve = Reserve()
    assert not reserve.is_nearly_full(10**9), "nothing is known: pairs are counted first"
    assert not reserve.learn(0)
    assert reserve.learn(1_000_000)
    assert 1_500_000 <= reserve.capacity < 1_500_000 + PAIRS
    assert not reserve.learn(1_100_000)
    assert not reserve.is_nearly_full(1_100_000)
    assert reserve.is_nearly_full(1_300_000)
    assert reserve.learn(1_300_000)
    assert reserve.capacity >= 1_950_000


def test_it_shrinks_only_if_it_stays_empty():
    """A reset of the opacities leaves few pairs for some hundred images, and more than before after that."""
    reserve = Reserve()
    reserve.learn(1_000_000)
    for _ in range(PATIENCE):
        assert not reserve.learn(100_000)
    assert not reserve.learn(900_000)
    for _ in range(PATIENCE):
        assert not reserve.learn(100_000)
    assert reserve.learn(100_000)
    assert reserve.capacity < 300_000
