"""Many images of a replay: complete, in order, in memory that is reused only when nothing refers
to it.
"""

import gc

import numpy as np
import pytest
import torch
import warp as wp
from test_replay import CAMERA, DEVICES, IMAGES, PLAIN, aside, counting, run  # noqa: F401

from gftorf_warp.render import replay as replaying
from gftorf_warp.render import series
from gftorf_warp.render.cuda import ReadbackRing
from gftorf_warp.render.series import Series

VIEWS = [
    (float(time), camera)
    for time in np.linspace(-0.01, 0.08, 9)
    for camera in (CAMERA, aside(0.1), CAMERA.resized(20, 15))
]


def one_by_one(run, names=IMAGES):  # noqa: F811
    """What a loop over checked calls gives."""
    render = run.renderer(names)
    return [
        {name: getattr(render(*view), name).cpu().numpy().copy() for name in names}
        for view in VIEWS
    ]


def assert_same(got, want):
    """To the bit."""
    assert len(got) == len(want)
    for one, other in zip(got, want, strict=True):
        assert one.keys() == other.keys()
        for name in one:
            np.testing.assert_array_equal(one[name], other[name], err_msg=name)


@pytest.fixture(params=[0, 3])
def ahead(request, monkeypatch):
    """How many images are on their way; on a CPU it makes no difference to what comes out."""
    right = Series.__init__

    def started(self, *arguments):
        right(self, *arguments)
        self.ahead = request.param

    monkeypatch.setattr(Series, "__init__", started)
    return request.param


def test_arrays_are_those_of_single_calls(run, ahead):  # noqa: F811, ARG001
    """Of several cameras and sizes; all of them are held,
    so memory that was reserved does not suffice.
    """
    want = one_by_one(run)
    times, cameras = zip(*VIEWS, strict=True)
    got = list(run.images(times, cameras))
    assert_same(got, want)
    assert float(np.abs(want[0]["distance"] - want[-3]["distance"]).max()) > 0.01


def test_renderings_on_the_device_are_those_of_single_calls(run, ahead):  # noqa: F811, ARG001
    """Images that are not computed have no elements, as in a call."""
    want = one_by_one(run, ("quads", "distance"))
    rows = []
    for rendering in Series(run.renderer(("quads", "distance")), VIEWS).on_device():
        assert rendering.phasor.numel() == 0
        rows.append(
            {name: getattr(rendering, name).cpu().numpy().copy() for name in ("quads", "distance")}
        )
    assert_same(rows, want)


@pytest.mark.parametrize("run", ["cpu"], indirect=True)
@pytest.mark.parametrize("where", ["host", "device"])
def test_images_that_overflowed_are_rendered_again(run, ahead, where, monkeypatch):  # noqa: F811
    """A capacity of a tenth of the pairs: incomplete images are rendered again,
    and none of them is returned.
    """
    want = one_by_one(run, PLAIN)
    render, right = run.renderer(PLAIN), replaying.Replay.draw
    incomplete = []

    def draw(self, time, camera):
        """As on CUDA: memory for some pairs; an image with more is incomplete, without an error."""
        target = right(self, time, camera)
        needed = int(target.packed[-1:].view(torch.int32))
        reserved = capacity[0]
        shown = replaying.replace(target.buffers.settings, pair_capacity=reserved)
        if needed > reserved:
            target.packed[:-1] = float("nan")
            incomplete.append((time, camera))
        buffers = type("Shown", (), {"settings": shown})
        return replaying.replace(target, buffers=buffers)

    def grow(self):
        capacity[0] = int(1.5 * self.largest) + 1

    capacity = [20]
    monkeypatch.setattr(replaying.Replay, "draw", draw)
    monkeypatch.setattr(replaying.Replay, "grow", grow)
    monkeypatch.setattr(replaying.Replay, "fits", lambda self: self.largest <= capacity[0])
    one = Series(render, VIEWS)
    if where == "host":
        got = list(one.on_host())
    else:
        got = [{n: getattr(r, n).numpy().copy() for n in PLAIN} for r in one.on_device()]
    assert_same(got, want)
    assert 1 + ahead <= len(incomplete) < len(VIEWS), (
        "those in flight as well; then the capacity suffices"
    )
    assert one.repeated == len(incomplete) or not ahead


def test_memory_is_reused_when_nothing_refers_to_it():
    """A part of an array keeps all of it; what is held beyond the reserve is a copy;
    nothing is ever overwritten.
    """
    ring = ReadbackRing(torch.zeros(8), ahead=1, kept=2)
    held = []
    for number in range(6):
        array = ring.keep(ring.copy(torch.full((8,), float(number))))
        held.append(array[2:6].reshape(2, 2)[1:])
        del array
    gc.collect()
    assert [float(one[0, 0]) for one in held] == [0, 1, 2, 3, 4, 5]
    assert [one.base.base is not None for one in held] == [True, True, False, False, False, False]
    for ticket in [ring.copy(torch.ones(8)) for _ in range(2)]:  # while two are held
        ring.release(ticket)
    held.clear()
    gc.collect()
    first = ring.keep(ring.copy(torch.ones(8)))
    address = first.ctypes.data
    del first
    gc.collect()
    got = {ring.keep(ring.copy(torch.ones(8))).ctypes.data for _ in range(8)}
    assert address in got
    assert len(got) == 4, "nothing was allocated"


@pytest.mark.parametrize("length", [1, 1024, 1025])
def test_memory_starts_where_pages_do(length):
    """Every copy, so that a disk takes it as it is; none reaches into another."""
    ring = ReadbackRing(torch.zeros(length), ahead=1, kept=3)
    held = [ring.keep(ring.copy(torch.full((length,), float(number)))) for number in range(3)]
    assert [one.ctypes.data % 4096 for one in held] == [0, 0, 0]
    assert [(one.shape, float(one.min()), float(one.max())) for one in held] == [
        ((length,), k, k) for k in range(3)
    ]


@pytest.mark.parametrize("kept", [2, 20])
def test_as_many_are_held_as_was_asked_for(run, kept, monkeypatch):  # noqa: F811
    """Memory of one camera's images, all of which are held."""
    made, right = [], ReadbackRing.__init__
    monkeypatch.setattr(
        ReadbackRing,
        "__init__",
        lambda self, *a, **k: made.append(k["kept"]) or right(self, *a, **k),
    )
    one = Series(run.renderer(PLAIN), [(0.001 * k, CAMERA) for k in range(8)])
    got = list(one.on_host(kept))
    assert made == [kept]
    starts = [min(array.ctypes.data for array in image.values()) for image in got]
    assert len(set(starts)) == 8
    assert all(start % 4096 == 0 for start in starts[:kept])


def test_a_loop_that_is_left_early_leaves_nothing_behind(run, ahead):  # noqa: F811, ARG001
    """The replay goes on as if nothing had been."""
    render = run.renderer(PLAIN)
    for got in Series(render, VIEWS).on_host():
        assert got["distance"].shape == (30, 40)
        break
    got, want = render(*VIEWS[3]), run.renderer(PLAIN)(*VIEWS[3])
    assert torch.equal(got.distance, want.distance)
    assert float(want.distance.max()) > 0.5


@pytest.mark.skipif("cuda" not in DEVICES, reason="needs a GPU")
@pytest.mark.parametrize("run", ["cuda"], indirect=True)
def test_a_reserve_that_is_too_small_on_a_gpu(run, monkeypatch):  # noqa: F811
    """Ten pairs: every image is whole all the same, from graphs as well."""
    want = one_by_one(run, PLAIN)
    for way in ("host", "device"):
        render, launched = run.renderer(PLAIN), []
        render(*VIEWS[0])
        render.reserve(10)
        monkeypatch.setattr(wp, "capture_launch", counting(wp.capture_launch, launched))
        one = Series(render, VIEWS)
        assert one.ahead == series.AHEAD
        if way == "host":
            got = list(one.on_host())
        else:
            got = [{n: getattr(r, n).cpu().numpy().copy() for n in PLAIN} for r in one.on_device()]
        assert_same(got, want)
        assert 1 <= one.repeated < len(VIEWS)
        assert launched
        monkeypatch.undo()
