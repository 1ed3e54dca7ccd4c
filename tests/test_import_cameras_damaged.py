"""Damaged recordings of cameras; test_damaged_files.py does the same without a look at memory."""

import tracemalloc

import kinect2_dump as kinect2
import numpy as np
import pytest
import recordings
from damaged_files import attempt
from hypothesis import given, settings
from hypothesis import strategies as st

from gftorf_warp.importers import kinect2_packets

MEMORY_MAX = 20 << 20  # [bytes] for files of a few kilobytes


@pytest.mark.parametrize("name", recordings.WRITERS)
def test_damage_takes_no_memory(name, tmp_path):
    """Whatever sizes a file claims, it is read, or refused before they are allocated."""
    outcomes = set()
    for seed in range(20):
        tracemalloc.start()
        try:
            done, outcome = attempt(f"import {name}", seed, tmp_path / str(seed) / "files")
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert outcome in ("read", "refused"), done
        assert peak < MEMORY_MAX, f"{done}: {peak} bytes"
        outcomes.add(outcome)
    assert "refused" in outcomes


@pytest.mark.parametrize("name", recordings.WRITERS)
def test_what_is_read_are_whole_quads(name, tmp_path):
    """Finite, with a time each, in order."""
    recordings.WRITERS[name](tmp_path)
    quads, times, shifts, poses = recordings.read(name, tmp_path)
    assert np.isfinite(quads).all()
    assert len(quads) == len(times) == len(shifts) == len(poses)
    assert (np.diff(times) >= 0).all()


TABLES = kinect2.tables()


@settings(max_examples=12, deadline=None, derandomize=True, database=None)
@given(
    first=st.booleans(),
    damage=st.lists(st.tuples(st.integers(0, len(TABLES[0]) // 4 - 1), st.binary(min_size=4))),
    shift=st.integers(0, 8),
)
def test_damaged_tables_of_a_lens_are_read_or_refused(first, damage, shift):
    """Of a Kinect: values of all kinds, infinities and NaN among them."""
    tables = [bytearray(table) for table in TABLES]
    for place, value in damage:
        tables[first][4 * place : 4 * place + len(value)] = value
    tables[first] = (bytes(shift) + tables[first])[: len(TABLES[0])]
    x, z = (np.frombuffer(t, "<f4").reshape(kinect2.HEIGHT, kinect2.WIDTH) for t in tables)
    try:
        lens = kinect2_packets.lens(x, z)
    except (ValueError, np.linalg.LinAlgError):
        return
    assert lens.fx > 0
    assert np.isfinite([lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion]).all()
