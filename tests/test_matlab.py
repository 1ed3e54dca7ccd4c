"""Our page of MATLAB 5 against what scipy writes, and against files made by hand."""

import io
import struct
import zlib

import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st

from gftorf_warp.data.matlab import UNPACKED_MAX, read_matrix


def saved(variables, **options):
    """Bytes that scipy writes."""
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, variables, **options)
    return buffer.getvalue()


def element(order, kind, content):
    """One element with its tag and padding."""
    return struct.pack(order + "2I", kind, len(content)) + content + bytes(-len(content) % 8)


def by_hand(order, values, stored="i2", kind=3, shape=(2, 3), flags=6):
    """A file with one matrix K of a class of one's own choice."""
    content = np.asarray(values, dtype=order + stored).tobytes(order="F")
    parts = [
        element(order, 6, struct.pack(order + "2I", flags, 0)),
        element(order, 5, struct.pack(order + "2i", *shape)),
        struct.pack(order + "I", 1 << 16 | 1) + b"K\0\0\0",
        element(order, kind, content),
    ]
    return (
        b"MATLAB 5.0 MAT-file".ljust(124)
        + struct.pack(order + "H", 0x100)
        + (b"IM" if order == "<" else b"MI")
        + element(order, 14, b"".join(parts))
    )


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(
    rows=st.integers(1, 5),
    columns=st.integers(1, 5),
    dtype=st.sampled_from(["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"]),
    packed=st.booleans(),
    seed=st.integers(0, 2**16),
)
def test_every_matrix_that_scipy_writes_is_read(rows, columns, dtype, packed, seed):
    """Any size and type, compressed or not, behind other variables of any kind."""
    matrix = (100 * np.random.default_rng(seed).random((rows, columns))).astype(dtype)
    data = saved(
        {"text": "a", "cell": np.array([1, "b"], dtype=object), "K": matrix}, do_compression=packed
    )
    got = read_matrix(data, "K")
    assert got.dtype == matrix.dtype
    np.testing.assert_array_equal(got, matrix)


@pytest.mark.parametrize("order", ["<", ">"])
def test_small_numbers_of_a_large_class_in_either_byte_order(order):
    """MATLAB stores whole doubles in fewer bytes; columns come first."""
    got = read_matrix(by_hand(order, [[1, 2, 3], [4, 5, -6]]), "K")
    assert got.dtype == np.float64
    np.testing.assert_array_equal(got, [[1, 2, 3], [4, 5, -6]])
    np.testing.assert_array_equal(
        scipy.io.loadmat(io.BytesIO(by_hand(order, [[1, 2, 3], [4, 5, -6]])))["K"], got
    )


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"x" * 500,
        saved({"other": 1.0}),
        saved({"K": np.array([[1j]])}),
        saved({"K": "text"}),
        saved({"K": np.zeros((0, 3))}),
        saved({"K": np.zeros((2,) * 6)}),
        saved({"K": {"a": 1.0}}),
        saved({"K": np.eye(3)})[:-8],
        saved({"K": np.eye(3)}, do_compression=True)[:-8],
        by_hand("<", [[1, 2, 3], [4, 5, 6]], shape=(3, 3)),
        by_hand("<", [[1, 2, 3], [4, 5, 6]], shape=(-2, -3)),
        by_hand("<", [[1, 2, 3], [4, 5, 6]], flags=17),
        by_hand("<", [[1, 2, 3], [4, 5, 6]], kind=8),
    ],
)
def test_anything_else_is_a_value_error(data):
    """Other kinds of variables, damage, and sizes that contradict the content."""
    with pytest.raises(ValueError, match=r"\w"):
        read_matrix(data, "K")


def test_a_compressed_bomb_is_not_unpacked():
    """A few kilobytes that claim to be a gigabyte end at a megabyte."""
    bomb = zlib.compress(bytes(64 * UNPACKED_MAX), 9)
    data = saved({"other": 1.0}) + struct.pack("<2I", 15, len(bomb)) + bomb
    assert len(data) < UNPACKED_MAX
    with pytest.raises(ValueError, match="unpack"):
        read_matrix(data, "K")


def test_arrays_of_more_axes_and_the_only_variable():
    """Recordings have three to five axes; without a name there must be one variable."""
    array = np.arange(24, dtype=np.int16).reshape(2, 3, 4)
    for compressed in (False, True):
        data = saved({"quads": array}, do_compression=compressed)
        np.testing.assert_array_equal(read_matrix(data, None), array)
    with pytest.raises(ValueError, match="one variable"):
        read_matrix(saved({"K": 1.0, "L": 2.0}), None)
    data = saved({"K": np.zeros((200, 200))}, do_compression=True)
    with pytest.raises(ValueError, match="unpack"):
        read_matrix(data, None, unpacked_max=1000)
