"""Lists of tiles out of a matrix of bits: those of a sort of the pairs, entry by entry,
however many of them fit.
"""

import contextlib

import numpy as np
import pytest
import torch
import warp as wp
from comparison import DEVICES
from test_tiles import HEIGHT, KINDS, WIDTH, splats

from gftorf_warp.kernels.rasterise import tile_bitmask
from gftorf_warp.kernels.rasterise.splat import Splat
from gftorf_warp.render import buffers as sizes
from gftorf_warp.render import stages
from gftorf_warp.render.buffers import Buffers, RenderSettings

# pixels per thread, columns and rows of a tile
SHAPES = [(1, 8, 4), (16, 8, 8), (16, 16, 16), (1, 16, 8)]
ALL, NONE = [0, 0, WIDTH, HEIGHT], [0, 0, 0, 0]  # boxes


def buffers_of(record, box, settings, device="cpu", *, marks=True):
    """Buffers whose splats are given, in an order of depth of their own,
    that makes its lists in one of the ways.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sizes, "MATRIX_MAX", sizes.MATRIX_MAX if marks else 0)
        buffers = Buffers(len(record), WIDTH, HEIGHT, settings, wp.get_device(device))
    assert buffers.marks == marks
    fill(buffers, record, box)
    return buffers


def fill(buffers, record, box):
    """Other splats for buffers."""
    order = np.random.default_rng(9).permutation(len(record)).astype(np.int32)
    buffers.splats.assign(wp.array(record, dtype=Splat, device="cpu"))
    buffers.box_px.assign(wp.array(box, dtype=wp.vec4i, device="cpu"))
    buffers.order[: len(record)].assign(order)


def lists_of(buffers):
    """Make the lists; return where each begins, their splats, and how many there would be."""
    stages.sort_by_tile(buffers)
    first, total = buffers.first.numpy(), int(buffers.total.numpy()[0])
    return first, buffers.ids.numpy()[: first[-1]], total


def is_same(got, want):
    """Assert that lists are equal to the bit."""
    for one, other in zip(got, want, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.fixture(params=SHAPES, ids=str)
def shape(request, monkeypatch):
    """Size of a tile on every device."""
    for kind in sizes.TILE_SHAPES:
        monkeypatch.setitem(sizes.TILE_SHAPES, kind, request.param)
    return request.param[1:]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [1, 2, 31, 32, 33, 63, 64, 65, 150, 1000])
def test_lists_are_those_of_a_stable_sort(count, shape, device):
    """Ellipses of every kind, so also tiles without a pair and splats over all tiles."""
    for kind in KINDS:
        record, box = splats(kind, count)
        got = lists_of(buffers_of(record, box, RenderSettings(), device))
        want = lists_of(buffers_of(record, box, RenderSettings(), device, marks=False))
        is_same(got, want)
        assert got[2] == len(got[1]) == got[0][-1]
        lengths = np.diff(got[0])
        assert len(lengths) == -(-WIDTH // shape[0]) * -(-HEIGHT // shape[1])
        if count == 1000 and kind in ("round", "far"):
            assert lengths.max() > 200, "every list is short"
        if count < 3 and kind == "small":
            assert (lengths == 0).any(), "every tile has a pair"


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("readers", "parts"), [(1, 1), (8192, 5), (1000, 3)])
def test_several_warps_read_a_tile(readers, parts, device, monkeypatch):
    """Parts go behind each other; ones without a pair, also the last, change nothing."""
    monkeypatch.setattr(sizes, "READERS", readers)
    monkeypatch.setitem(sizes.TILE_SHAPES, "cpu", sizes.TILE_SHAPES["cuda"])
    count = 4 * 2048 + 5  # a warp reads 64 words, of 2,048 splats, at once
    record, box = (np.tile(value, (count // 150 + 1, 1))[:count] for value in splats("small"))
    order = np.random.default_rng(9).permutation(count)
    box[order[2048:4096]] = NONE
    box[order[-5:]] = NONE
    buffers = buffers_of(record, box, RenderSettings(), device)
    assert buffers.parts == parts
    got = lists_of(buffers)
    is_same(got, lists_of(buffers_of(record, box, RenderSettings(), device, marks=False)))
    assert got[2] > count / 3


@pytest.mark.parametrize("device", DEVICES)
def test_a_splat_over_all_tiles_is_in_every_list(device):
    """Between others that are nowhere."""
    record, box = splats("round", 40)
    record[:, :2], record[:, 2:5] = (WIDTH / 2, HEIGHT / 2), (-1e-6, 0.0, -1e-6)
    box[:] = NONE
    box[7] = ALL
    buffers = buffers_of(record, box, RenderSettings(), device)
    first, ids, total = lists_of(buffers)
    assert total == buffers.tiles
    assert (ids == 7).all()
    np.testing.assert_array_equal(first, np.arange(buffers.tiles + 1))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("capacity", [None, 0, 50])
def test_no_pairs_at_all(capacity, device):
    """Lists without an entry, and no memory for them if nobody reserved any."""
    record, box = splats("round", 33)
    buffers = buffers_of(record, np.zeros_like(box), RenderSettings(pair_capacity=capacity), device)
    first, ids, total = lists_of(buffers)
    assert total == len(ids) == 0
    assert len(buffers.ids) == (capacity or 0)
    np.testing.assert_array_equal(first, np.zeros(buffers.tiles + 1))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("share", [0.0, 1e-3, 0.4, 1.0, 1.2])
@pytest.mark.parametrize("count", [60, 10_000])
def test_what_does_not_fit_is_dropped_and_counted(count, share, device):
    """The first pairs in the order of tiles stay, nothing is written behind the reserve,
    and lists end there.
    """
    kind = "round" if count < 100 else "small"
    record, box = splats(kind, count)
    want_first, want_ids, want_total = lists_of(
        buffers_of(record, box, RenderSettings(), device, marks=False)
    )
    capacity = int(share * want_total)
    buffers = buffers_of(record, box, RenderSettings(pair_capacity=capacity), device)
    buffers.ids = wp.full(capacity + 100, -7, dtype=wp.int32, device=device)
    tight = capacity < want_total
    refused = (
        pytest.raises(ValueError, match=f"has {want_total} ") if tight else contextlib.nullcontext()
    )
    with refused:
        stages.sort_by_tile(buffers)
        buffers.check_capacity()
    assert int(buffers.total.numpy()[0]) == want_total
    np.testing.assert_array_equal(buffers.first.numpy(), np.minimum(want_first, capacity))
    ids, kept = buffers.ids.numpy(), min(capacity, want_total)
    np.testing.assert_array_equal(ids[:kept], want_ids[:kept])
    assert (ids[kept:] == -7).all()


@pytest.mark.parametrize("device", DEVICES)
def test_a_frame_forgets_its_last_lists(device):
    """Bits of one rendering are gone in the next one, in the same memory."""
    buffers = buffers_of(*splats("far", 200), RenderSettings(pair_capacity=200_000), device)
    before = lists_of(buffers)
    fill(buffers, *splats("small", 200))
    place = buffers.ids.ptr, buffers.first.ptr, buffers.array("bits", buffers.matrix, wp.uint32).ptr
    got = lists_of(buffers)
    assert place == (
        buffers.ids.ptr,
        buffers.first.ptr,
        buffers.array("bits", buffers.matrix, wp.uint32).ptr,
    )
    assert before[2] > 2 * got[2]
    is_same(got, lists_of(buffers_of(*splats("small", 200), RenderSettings(), device, marks=False)))


def test_three_launches_and_no_sort(monkeypatch):
    """What a step of training pays for."""
    buffers, launched = buffers_of(*splats("round"), RenderSettings(pair_capacity=100_000)), []
    launch = wp.launch
    monkeypatch.setattr(
        wp, "launch", lambda kernel, *a, **k: launched.append(kernel.key) or launch(kernel, *a, **k)
    )
    monkeypatch.setattr(wp.utils, "radix_sort_pairs", None)
    stages.sort_by_tile(buffers)
    assert launched == ["mark_pairs", "count_bits", "list_bits"]
    assert len(buffers.keys) == 0, "memory for a sort"


def test_too_large_a_matrix_and_pairs_in_order_are_sorted(monkeypatch):
    """The bound is in bytes and counts words that only fill up;
    gradients in one order need pairs that are sorted.
    """
    monkeypatch.setitem(sizes.TILE_SHAPES, "cpu", (1, 8, 4))
    tiles, words = -(-19 * 18 // tile_bitmask.GROUP) * tile_bitmask.GROUP, 10  # of 257 splats

    def marks(**settings):
        return Buffers(257, WIDTH, HEIGHT, RenderSettings(**settings), wp.get_device("cpu")).marks

    monkeypatch.setattr(sizes, "MATRIX_MAX", 4 * tiles * words)
    assert marks()
    assert not marks(deterministic=True)
    monkeypatch.setattr(sizes, "MATRIX_MAX", 4 * tiles * words - 1)
    assert not marks()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_a_graph_makes_the_lists_of_new_splats():
    """Zeroing, marking, counting, summing and listing can be captured,
    and nothing waits for the host.
    """
    buffers = buffers_of(*splats("round", 200), RenderSettings(pair_capacity=200_000), "cuda")
    lists_of(buffers)
    with wp.ScopedCapture(device=buffers.device) as capture:
        stages.sort_by_tile(buffers)
    for kind in ("small", "far"):
        fill(buffers, *splats(kind, 200))
        wp.capture_launch(capture.graph)
        first, total = buffers.first.numpy(), int(buffers.total.numpy()[0])
        want = lists_of(buffers_of(*splats(kind, 200), RenderSettings(), "cuda", marks=False))
        is_same((first, buffers.ids.numpy()[: first[-1]], total), want)
