"""Lists of tiles: no pair that a pixel needs is missing, none too many,
and who writes them does not matter.
"""

import numpy as np
import pytest
import torch
import warp as wp
from comparison import DEVICES

from gftorf_warp.kernels.rasterise import tiles
from gftorf_warp.kernels.rasterise.splat import Splat
from gftorf_warp.render.buffers import LANES_PER_SPLAT

WIDTH, HEIGHT = 150, 70  # neither is a multiple of a tile
SHAPES = [(8, 8), (8, 4)]  # of the CPU and of CUDA [px]
KINDS = ["small", "round", "long", "needle", "far", "faint"]


def splats(kind, count=150):
    """Return records [count, 16] and boxes [count, 4] of ellipses of one kind,
    as projection writes them.
    """
    rng = np.random.default_rng(KINDS.index(kind))
    centre = rng.uniform(-20, [WIDTH + 20, HEIGHT + 20], (count, 2))
    axes = {
        "small": rng.uniform(0.5, 2.0, (count, 2)),
        "round": np.exp(rng.uniform(0, 5, (count, 1))) * rng.uniform(0.8, 1.0, (count, 2)),
        "long": np.exp(rng.uniform([-0.6, 2.0], [0.5, 5.0], (count, 2))),
        # determinant lost in float32
        "needle": np.exp(rng.uniform([-0.6, 5.0], [-0.5, 8.5], (count, 2))),
        "far": np.exp(rng.uniform(4, 8, (count, 2))),
        "faint": rng.uniform(0.5, 30.0, (count, 2)),
    }[kind]
    if kind == "far":
        centre += rng.normal(size=(count, 2)) * 2.0 * axes
    angle = rng.uniform(0, np.pi, count)
    turn = np.stack(
        [
            np.stack([np.cos(angle), -np.sin(angle)], -1),
            np.stack([np.sin(angle), np.cos(angle)], -1),
        ],
        -2,
    )
    covariance = np.einsum("nij,nj,nkj->nik", turn, axes**2, turn)
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    determinant = np.prod(axes, 1) ** 2
    opacity = (
        rng.uniform(1 / 255, 1.2 / 255, count) if kind == "faint" else rng.uniform(0.02, 1.0, count)
    )
    cutoff = 2 * np.log(255 * opacity) + 1e-5
    record = np.zeros((count, 16))
    record[:, :2], record[:, 5], record[:, 6] = centre, opacity, -0.5 * cutoff
    record[:, 2], record[:, 3], record[:, 4] = (
        -0.5 * yy / determinant,
        xy / determinant,
        -0.5 * xx / determinant,
    )
    reach = np.sqrt(cutoff[:, None] * np.stack([xx, yy], 1)) * 1.0001 + 1e-3
    size = np.array([WIDTH, HEIGHT])
    low, high = np.ceil(centre - reach - 0.5), np.floor(centre + reach - 0.5) + 1
    box = np.concatenate([np.clip(low, 0, size), np.clip(high, 0, size)], 1).astype(np.int32)
    box[(box[:, 2] <= box[:, 0]) | (box[:, 3] <= box[:, 1])] = 0
    return record.astype(np.float32), box


def lists(record, box, shape, capacity=None, device="cpu"):
    """Return keys and ids of the pairs in the order they are emitted,
    and the number of pairs there would be.
    """
    order = np.random.default_rng(9).permutation(len(record)).astype(np.int32)
    values, threads = ((order, int), (record, Splat), (box, wp.vec4i)), LANES_PER_SPLAT[device]
    where = [
        *(wp.array(value, dtype=dtype, device=device) for value, dtype in values),
        *shape,
        threads,
    ]
    counts, ends = (wp.zeros(len(record), dtype=int, device=device) for _ in range(2))
    wp.launch(tiles.count_pairs, (len(record), threads), where, [counts], device=device)
    wp.utils.array_scan(counts, ends, inclusive=True)
    room = int(ends.numpy()[-1]) if capacity is None else capacity
    columns, rows = -(-WIDTH // shape[0]), -(-HEIGHT // shape[1])
    keys, ids, total = (wp.full(n, -1, dtype=int, device=device) for n in (room, room, 1))
    inputs = [*where, columns, columns * rows, ends, room]
    wp.launch(tiles.emit_pairs, (len(record), threads), inputs, [keys, ids, total], device=device)
    return keys.numpy(), ids.numpy(), int(total.numpy()[0])


def touched(record, box, shape, dtype, slack):
    """Return [tiles, N], by looking at every pixel: whether the power of one reaches its lower
    bound less ``slack``.
    """
    columns, rows = -(-WIDTH // shape[0]), -(-HEIGHT // shape[1])
    y, x = np.mgrid[: rows * shape[1], : columns * shape[0]]
    found = np.zeros((rows * columns, len(record)), bool)
    for n, (q, b) in enumerate(zip(record.astype(dtype), box, strict=True)):
        dx, dy = q[0] - (x + 0.5).astype(dtype), q[1] - (y + 0.5).astype(dtype)
        reached = (dx * q[2] + dy * q[3]) * dx + (dy * q[4]) * dy >= q[6] * (1 + slack) - slack
        reached &= (x >= b[0]) & (x < b[2]) & (y >= b[1]) & (y < b[3])
        found[:, n] = (
            reached.reshape(rows, shape[1], columns, shape[0]).any(axis=(1, 3)).reshape(-1)
        )
    return found


def rectangles(record, box, shape):
    """Return [tiles, N]: whether the ellipse reaches the rectangle of a tile's pixel centres;
    its form is convex.
    """
    columns, rows = -(-WIDTH // shape[0]), -(-HEIGHT // shape[1])
    found = np.zeros((rows * columns, len(record)), bool)
    for n, (q, b) in enumerate(zip(record.astype(np.float64), box, strict=True)):
        if b[2] == 0:
            continue
        row, column = np.mgrid[
            b[1] // shape[1] : -(-b[3] // shape[1]), b[0] // shape[0] : -(-b[2] // shape[0])
        ]
        left, top = column * shape[0] + 0.5 - q[0], row * shape[1] + 0.5 - q[1]
        right, bottom = left + shape[0] - 1, top + shape[1] - 1
        best = np.full(row.shape, -np.inf)
        for u in (np.clip(0, left, right), left, right):  # along an upright line
            v = np.clip(-0.5 * q[3] * u / q[4], top, bottom)
            best = np.maximum(best, q[2] * u * u + q[3] * u * v + q[4] * v * v)
        for v in (np.clip(0, top, bottom), top, bottom):  # along a level one
            u = np.clip(-0.5 * q[3] * v / q[2], left, right)
            best = np.maximum(best, q[2] * u * u + q[3] * u * v + q[4] * v * v)
        found[(row * columns + column)[best >= q[6]], n] = True
    return found


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("kind", KINDS)
def test_lists_hold_what_a_pixel_needs_and_little_else(kind, shape):
    """Every pixel finds its splats, in float32 and float64;
    what else is listed touches the tile's rectangle.
    """
    record, box = splats(kind)
    keys, ids, total = lists(record, box, shape)
    listed = np.zeros((keys.max() + 1, len(record)), int)
    np.add.at(listed, (keys, ids), 1)
    assert total == len(keys)
    assert listed.max() == 1, "a pair twice"
    for dtype in (np.float32, np.float64):
        needed = touched(record, box, shape, dtype, 0.0)[: len(listed)]
        assert needed.sum() > 50
        assert not (needed & (listed == 0)).any(), (
            f"{(needed & (listed == 0)).sum()} of {needed.sum()} pairs missing"
        )
    exact = rectangles(record, box, shape)
    assert exact.sum() == exact[: len(listed)].sum()
    spare = (listed == 1) & ~exact[: len(listed)]
    if kind == "needle":  # float32 does not know their width
        assert spare.sum() < 0.3 * exact.sum()
    else:
        assert spare.sum() <= 1 + 2e-3 * exact.sum()


def test_pairs_are_in_the_order_that_a_stable_sort_by_tile_needs():
    """Splats come in depth order, tiles of one in rows."""
    record, box = splats("round")
    wanted = lists(record, box, (8, 4))
    assert wanted[2] > 3000
    order = np.random.default_rng(9).permutation(len(record))
    rank = np.argsort(order)[wanted[1]]
    assert (np.diff(rank) >= 0).all()
    assert (np.diff(wanted[0])[np.diff(rank) == 0] > 0).all()


@pytest.mark.parametrize("capacity", [0, 1, 100, 20_000])
def test_a_capacity_keeps_the_nearest_pairs_and_marks_what_is_free(capacity):
    """Pairs that do not fit are missing at the end; places that none takes carry the number of
    tiles.
    """
    record, box = splats("round", 60)
    keys, ids, total = lists(record, box, (8, 4))
    assert 200 < total < 20_000
    got_keys, got_ids, got_total = lists(record, box, (8, 4), capacity=capacity)
    kept = min(capacity, total)
    assert got_total == total
    np.testing.assert_array_equal(got_keys[:kept], keys[:kept])
    np.testing.assert_array_equal(got_ids[:kept], ids[:kept])
    assert (got_keys[kept:] == 19 * 18).all()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [0, 1, 2, 31, 32, 33, 34, 1089, 5000])
def test_lists_begin_where_sorted_keys_do(count, device):
    """Of every tile, also of those without a pair; behind the last one are the places that no pair
    takes.
    """
    rng, columns = np.random.default_rng(count), 40
    for used in (1, 5, columns + 1):  # the last one: some places are free
        sorted_keys = np.sort(
            rng.choice(columns + 1, used, replace=False)[rng.integers(0, used, count)]
        )
        keys = wp.array(sorted_keys, dtype=wp.int32, device=device)
        first, lanes = wp.full(columns + 1, -1, dtype=int, device=device), LANES_PER_SPLAT[device]
        wp.launch(
            tiles.tile_starts, (columns + 1, lanes), [keys, count, lanes], [first], device=device
        )
        np.testing.assert_array_equal(
            first.numpy(), np.searchsorted(sorted_keys, np.arange(columns + 1))
        )


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("capacity", [None, 500])
@pytest.mark.parametrize("kind", KINDS)
def test_a_warp_writes_the_pairs_of_a_splat_as_one_thread_does(kind, capacity):
    """On CUDA lists are those of the CPU, pair by pair: without contraction both round alike."""
    record, box = splats(kind)
    for got, want in zip(
        *(lists(record, box, (8, 4), capacity, device) for device in ("cuda", "cpu")), strict=True
    ):
        np.testing.assert_array_equal(got, want)


def test_boxes_cut_lists():
    """A splat is listed nowhere outside the tiles of its box, however far its ellipse reaches:
    the 3-sigma square.
    """
    record, box = splats("round")
    box = np.where(box[:, 2:3] > 0, np.array([16, 16, 48, 32], np.int32), 0).astype(np.int32)
    keys, _, total = lists(record, box, (8, 4))
    columns = -(-WIDTH // 8)
    assert total > 100
    assert set(keys % columns) == {2, 3, 4, 5}
    assert set(keys // columns) == {4, 5, 6, 7}


def test_a_needle_across_a_large_image_keeps_its_pixels(monkeypatch):
    """Far from the centre of a needle float32 loses much of the power;
    what it decides in a pixel's favour counts.
    """
    monkeypatch.setattr("test_tiles.WIDTH", 1280)
    monkeypatch.setattr("test_tiles.HEIGHT", 640)
    record, box = splats("needle", 120)
    keys, ids, _ = lists(record, box, (8, 4))
    needed = touched(record, box, (8, 4), np.float32, 0.0)
    assert needed.sum() > 20_000
    needed[keys, ids] = False
    assert not needed.any()
