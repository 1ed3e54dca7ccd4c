"""Captures, our own folders: writing is undone by reading, every value is checked,
and what is wrong is named.
"""

import dataclasses
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from ftorf_folder import random_poses
from sequences import NAMES, changed, sequence_of, values_of

from gftorf_warp import Sequence, Truth
from gftorf_warp.data import specs
from gftorf_warp.data.check import check
from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.data.exr import read_parts, write_parts
from gftorf_warp.data.write import write
from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.scene.sensor import Sensor
from gftorf_warp.sim.scenes import SCENES
from gftorf_warp.sim.simulate import simulate

ROOT = Path(__file__).parents[1]
FRAMES, HEIGHT, WIDTH = 7, 5, 6


def recording(**changes):
    """Seven raw frames, one missing, of any shifts and two frequencies,
    with everything that can be stored.
    """
    rng = np.random.default_rng(5)
    shape = (FRAMES, HEIGHT, WIDTH)
    measured = np.arange(FRAMES) != 5
    flow = {0: rng.normal(size=(2, HEIGHT, WIDTH)).astype(np.float32)}
    flow[0][:, 2, 3] = np.nan
    fields = {
        "quads": rng.normal(size=shape).astype(np.float32) * measured[:, None, None],
        "measured": measured,
        "shifts": np.array([0.1, 2.2, 4.3, 0.1, 2.2, 4.3, 6.1]),
        "times": np.array([0, 0, 0.01, 0.023, 0.03, 0.04, 1 / 3]),
        "f_mod_hz": 2e7,
        "frequencies_hz": np.array([2e7, 2e7, 2e7, 2e7, 6e7, 6e7, 6e7]),
        "cycle_length": 7,
        "exposures": np.linspace(1e-3, 2e-3, FRAMES),
        "sensor": {"adc_bits": 12, "maker": "nobody", "shifts": [0.5, 1.0]},
        "phase_offset": 0.3,
        "dc_offset": 0.2,
        "fx": 5.5,
        "fy": 5.25,
        "cx": 3.1,
        "cy": 2.4,
        "distortion": (0.1, -0.02, 0.001, 0.002, 0.0),
        "camera_from_world": random_poses(FRAMES, rng),
        "quad_scale": 4.0,
        "colour": {0: rng.random((4, 3, 3)).astype(np.float32)},
        "colour_intrinsics": (3.3, 3.4, 1.5, 2.0),
        "colour_from_world": random_poses(FRAMES, rng),
        "novel_from_world": random_poses(2, rng),
        "forward_flow": flow,
        "backward_flow": {4: flow[0] + 1},
    }
    distance = rng.uniform(1, 5, shape).astype(np.float32)
    distance[2, 1, 1] = np.nan
    truth = Truth(
        distance=distance,
        known=np.ones(FRAMES, dtype=bool),
        phasor_distance=distance + 0.1,
        amplitude=rng.random(shape).astype(np.float32),
        body=rng.integers(-1, 3, shape),
        layers={
            name: rng.normal(size=(FRAMES, channels, HEIGHT, WIDTH)).astype(np.float32)
            for name, channels in (
                ("ambient", 1),
                ("direct", 3),
                ("error", 1),
                ("phasor.1", 2),
                ("phasor.3", 2),
            )
        }
        | {
            "z_depth": np.full((FRAMES, 1, HEIGHT, WIDTH), np.nan, np.float32),
            "normal": np.ones((7, 3, 5, 6), "f4"),
        },
    )
    return sequence_of(**{**fields, **changes}), truth


@pytest.fixture
def folder(tmp_path):
    """A capture with everything in it."""
    return write("capture", tmp_path / "seq", *recording(), readme="# a capture\n")


def edit(folder, change):
    """Change capture.json, and drop the manifest that would notice."""
    path = folder / "capture.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    (folder / "MANIFEST.sha256").unlink(missing_ok=True)


def test_writing_is_undone_by_reading(folder):
    """Every field: images and numbers bit by bit, poses, stored inverted, within rounding."""
    (want, truth), got = recording(), Sequence.open(folder)
    read = values_of(got)
    for name, one in values_of(want).items():
        other = read[name]
        if name.endswith("_from_world"):
            np.testing.assert_allclose(other, one, atol=1e-14, err_msg=name)
        elif isinstance(one, dict) and name != "sensor":
            assert one.keys() == other.keys(), name
            for n in one:
                assert one[n].tobytes() == other[n].tobytes(), name
        elif isinstance(one, np.ndarray):
            np.testing.assert_array_equal(other, one, err_msg=name)
            assert other.dtype == one.dtype, name
        else:
            assert other == one, name
    known = got.truth()
    for field in dataclasses.fields(Truth):
        one, other = (
            {"": v} if not isinstance(v, dict) else v
            for v in (getattr(t, field.name) for t in (truth, known))
        )
        assert one.keys() == other.keys(), field.name
        for name in one:
            np.testing.assert_array_equal(other[name], one[name], err_msg=f"{field.name} {name}")
    assert not list(folder.parent.glob(".*"))


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_an_amplitude_that_could_not_be_read_is_not_written(tmp_path, value):
    """Where it is unknown, the raw frame is not known."""
    sequence, truth = recording()
    truth.amplitude[3, 2, 1] = value
    with pytest.raises(UsageError, match="amplitude"):
        write("capture", tmp_path / "seq", sequence, truth)
    truth.known[3] = False
    write("capture", tmp_path / "seq", sequence, truth)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_tap_sum_that_could_not_be_read_is_not_written(tmp_path, value):
    """As a quad that is no number."""
    sums = {2: np.full((HEIGHT, WIDTH), value, np.float32)}
    with pytest.raises(UsageError, match="tap_sums"):
        write("capture", tmp_path / "seq", dataclasses.replace(recording()[0], tap_sums=sums))
    assert not any(tmp_path.iterdir())


def test_every_field_names_its_source_and_is_described(folder):
    """What a sequence holds is filled from described values,
    and the page beside the descriptions names all of them.
    """
    got = Sequence.open(folder)
    names = set(NAMES)
    assert names <= set(got.sources)
    assert all(source.startswith(("file ", "default ")) for source in got.sources.values())
    fields = specs.fields("capture").values()
    filled = {name for field in fields for name in field.fills}
    assert filled == names | {f.name for f in dataclasses.fields(Truth)}
    page = (ROOT / "data_specs" / "README.md").read_text(encoding="utf-8")
    for field in fields:
        assert f"`{field.paths[0]}`" in page, field.name
        assert not field.key or f"`{field.key}`" in page, field.name
        assert field.kind in {"json", "exr", "other"}, field.name
        assert field.role in {"measurement", "calibration", "truth", "check"}, field.name
    parts = {
        (name, part): channels.keys()
        for name in ("tof/000000", "colour/000000", "truth/000000")
        for part, channels in read_parts(folder / f"{name}.exr").items()
    }
    described = {
        (f.paths[0].replace("{id}", "000000").removesuffix(".exr"), f.key): set(f.channels)
        for f in fields
    }
    for (file, part), channels in parts.items():
        assert described[file, re.sub("[0-9]+$", "{h}", part)] == set(channels), part


def test_a_minimal_capture_has_no_more_than_it_needs(tmp_path):
    """Without colour, flow, truth, exposures: what is absent is absent again."""
    bare = {
        "distortion": None,
        "frequencies_hz": None,
        "exposures": None,
        "sensor": {},
        "quad_scale": None,
        "colour": {},
        "colour_intrinsics": None,
        "colour_from_world": None,
        "novel_from_world": None,
        "forward_flow": {},
        "backward_flow": {},
    }
    got = Sequence.open(write("capture", tmp_path / "seq", recording(**bare)[0]))
    for name, value in bare.items():
        assert values_of(got)[name] == value, name
    assert got.truth() is None
    assert sorted(p.name for p in (tmp_path / "seq").iterdir()) == [
        "MANIFEST.sha256",
        "capture.json",
        "tof",
    ]


def test_an_instant_has_no_exposure(tmp_path):
    """A sensor that takes instants is recorded and read again; no exposure is of no length."""
    options = {"frames": 4, "size": (16, 12), "format": "capture"}
    path = simulate("demo", tmp_path / "a", overrides=["sensor=ftorf_synthetic"], **options)
    assert Sequence.open(path).exposures is None
    assert Sequence.open(simulate("demo", tmp_path / "b", **options)).exposures.tolist() == (
        [Sensor().exposure_s] * 4
    )
    with pytest.raises(UsageError, match="exposures"):
        write("capture", tmp_path / "c", recording(exposures=np.zeros(FRAMES))[0])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.update(schema="picture"), ("schema", "picture")),
        (lambda c: c.update(version="2.0"), ("version", "2.0")),
        (lambda c: c.update(depth_range=15), ("depth_range",)),
        (lambda c: c["sensor"].update(gain=1), ("sensor", "gain")),
        (lambda c: c["frames"][2].update(phase=1), ("frames[2]", "phase")),
        (lambda c: c["frames"][3].pop("t"), ("frames[3].t",)),
        (lambda c: c["frames"][3].update(t="soon"), ("frames.t", "numbers")),
        (lambda c: c["frames"][3].update(t=float("nan")), ("frames.t", "finite")),
        (lambda c: c["frames"][3].update(t=0.001), ("frames.t", "never decrease")),
        (lambda c: c["frames"][3].update(f_mod_hz=0), ("frames.f_mod_hz", "Hz")),
        (lambda c: c["frames"][3].update(f_mod_hz=-2e7), ("frames.f_mod_hz", "Hz")),
        (lambda c: c["frames"][3].update(exposure=0), ("frames.exposure",)),
        (lambda c: c["frames"][3].update(measured=1), ("frames.measured", "true or false")),
        (lambda c: c["frames"][3].update(id=9), ("frames.id",)),
        (
            lambda c: c["frames"][3].update(camera_to_world=[[1, 0], [0, 1]]),
            ("frames.camera_to_world",),
        ),
        (
            lambda c: c["frames"][3]["camera_to_world"][0].__setitem__(0, 9),
            ("frames.camera_to_world", "rotations"),
        ),
        (lambda c: c["cameras"]["tof"]["K"][0].__setitem__(1, 1), ("cameras.tof.K",)),
        (lambda c: c["cameras"]["tof"].update(size=[6, 0]), ("cameras.tof.size",)),
        (lambda c: c["cameras"]["tof"].update(size=[5, 6]), ("quads", "wrong shape", "(5, 6)")),
        (lambda c: c["cameras"]["tof"].update(size=[10**30, 6]), ("cameras.tof.size",)),
        (
            lambda c: c["frames"][5].update(measured=True),
            ("quads: no such file", "found none for 5"),
        ),
        (lambda c: c.update(frames=[]), ("frames",)),
        (lambda c: c.update(frames={"0": {}}), ("frames",)),
        (lambda c: c["units"].update(length="mm"), ("units.length", "mm")),
    ],
)
def test_what_is_wrong_in_the_description_is_named(folder, change, words):
    """File, key, what was expected, what was found."""
    edit(folder, change)
    with pytest.raises(InputError) as caught:
        Sequence.open(folder)
    for word in (
        "capture.json" if "quads" not in words[0] else "exr" if "shape" in words[1] else "tof",
        *words,
    ):
        assert word in str(caught.value)


def test_our_own_additions_are_ignored(folder):
    """Keys that begin with x- are for whoever wrote them."""
    edit(folder, lambda c: (c.update({"x-lab": [1]}), c["frames"][0].update({"x-temperature": 40})))
    assert Sequence.open(folder).frames == FRAMES


def test_all_problems_are_named_at_once(folder):
    """One pass, one error."""
    edit(
        folder,
        lambda c: (
            c.update(axes="opengl"),
            c["frames"][0].update(t="now"),
            c["units"].update(time="ms"),
        ),
    )
    with pytest.raises(InputError, match="3 problems"):
        Sequence.open(folder)


@pytest.mark.parametrize(
    "name", ["tof/000003.exr", "colour/000000.exr", "truth/000002.exr", "capture.json"]
)
def test_a_changed_file_is_noticed(folder, name):
    """One flipped bit anywhere, and the manifest knows."""
    data = bytearray((folder / name).read_bytes())
    data[len(data) // 2] ^= 1
    (folder / name).write_bytes(bytes(data))
    with pytest.raises(InputError, match=re.escape(name)):
        Sequence.open(folder).truth()


def test_a_file_that_is_cut_off_is_refused_without_a_manifest(folder, capfd):
    """At every length: never fewer parts or other pixels without an error."""
    (folder / "MANIFEST.sha256").unlink()
    path = folder / "tof/000000.exr"
    data = path.read_bytes()
    for length in range(0, len(data), max(1, len(data) // 40)):
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match=r"tof/000000\.exr"):
            Sequence.open(folder)
    capfd.readouterr()


def test_half_precision_and_missing_parts_are_refused(folder, tmp_path):
    """A quad in half precision has lost its digits; a part by another name is not the quad."""
    (folder / "MANIFEST.sha256").unlink()
    with pytest.raises(ValueError, match="float16"):
        write_parts(tmp_path / "a.exr", {"raw": {"q": np.zeros((HEIGHT, WIDTH), np.float16)}})
    for parts, word in (
        ({"quad": {"q": np.zeros((HEIGHT, WIDTH), np.float32)}}, "no such part"),
        ({"raw": {"v": np.zeros((HEIGHT, WIDTH), np.float32)}}, "wrong channels"),
        ({"raw": {"q": np.full((HEIGHT, WIDTH), np.nan, np.float32)}}, "not finite"),
    ):
        (folder / "tof/000000.exr").unlink()
        write_parts(folder / "tof/000000.exr", parts)
        with pytest.raises(InputError, match=word):
            Sequence.open(folder)


def test_layers_are_checked_too(folder, tmp_path):
    """Wrong channels, sizes and numbers of a layer; what nobody describes is nobody's;
    names and shapes on writing.
    """
    (folder / "MANIFEST.sha256").unlink()
    path, image = folder / "truth/000002.exr", np.ones((HEIGHT, WIDTH), np.float32)
    distance = {"distance": {"distance": image}}
    for part, word in (
        ({"normal": {"x": image, "y": image}}, "normal: wrong channels"),
        ({"error": {"error": np.full_like(image, np.inf)}}, "error: not finite"),
        ({"phasor.2": {"re": image, "im": np.full_like(image, np.nan)}}, "phasor.2: not finite"),
        ({"ambient": {"reflectance": np.ones((2, 2), np.float32)}}, "ambient: wrong shape"),
    ):
        path.unlink()
        write_parts(path, part)
        with pytest.raises(InputError, match=word):
            Sequence.open(folder).truth()
    path.unlink()
    write_parts(path, {**distance, "mine": {"a": image}, "phasor.0": {"re": image}})
    got = Sequence.open(folder).truth().layers
    assert set(got) == set(recording()[1].layers)
    assert np.isnan(got["normal"][2]).all()
    sequence, truth = recording()
    for layers, word in (
        ({"mine": image}, "no layer"),
        ({"normal": np.ones((FRAMES, 1, HEIGHT, WIDTH))}, "shape"),
    ):
        with pytest.raises(ValueError, match=word):
            write(
                "capture", tmp_path / "other", sequence, dataclasses.replace(truth, layers=layers)
            )
    full = {"ambient": np.full((FRAMES, 1, HEIGHT, WIDTH), np.inf)}
    with pytest.raises(UsageError, match="layers"):
        write("capture", tmp_path / "other", sequence, dataclasses.replace(truth, layers=full))


def test_a_link_out_of_the_folder_is_not_followed(folder, tmp_path):
    """What lies outside is not part of the capture, even if it looks like it."""
    shutil.copy(folder / "tof/000000.exr", tmp_path / "outside.exr")
    (folder / "tof/000000.exr").unlink()
    (folder / "tof/000000.exr").symlink_to(tmp_path / "outside.exr")
    with pytest.raises(InputError, match="in this folder"):
        Sequence.open(folder)


def test_three_shifts_two_frequencies_and_no_frame_rate(tmp_path):
    """A simulated sensor with three shifts is stored and decoded; a frame rate cannot be given;
    check reads it.
    """
    sensor = Sensor(shifts=(0.0, 2 * np.pi / 3, 4 * np.pi / 3), f_mod_hz=3e7)
    scene = dataclasses.replace(SCENES["demo"], sensor=sensor, bodies=SCENES["demo"].bodies[:1])
    with pytest.raises(UsageError, match="--format capture"):
        simulate(scene, tmp_path / "other", frames=8, size=(24, 18))
    path = simulate(scene, tmp_path / "seq", frames=8, size=(24, 18), format="capture")
    sequence = Sequence.open(path)
    truth = sequence.truth()
    np.testing.assert_allclose(
        closed_form_distance(sequence, 0), truth.phasor_distance[0], atol=1e-5
    )
    assert np.abs(truth.phasor_distance[0] - truth.distance[0]).max() < 0.2
    assert {sequence.calibration.settings["f_mod_hz"], sequence.calibration.f_mod_hz} == {3e7}
    np.testing.assert_allclose(sequence.exposures, sensor.exposure_s)
    assert "capture sequence" in str(check(path))
    with pytest.raises(UsageError, match="frame rate"):
        Sequence.open(path, frame_rate_hz=120.0)


def test_a_cycle_is_complete_if_all_of_its_frequencies_are(folder):
    """Seven raw frames of two frequencies, one of them missing; read as quartets,
    the first has one frequency.
    """
    read = Sequence.open(folder)
    assert (read.cycle, read.frequencies, read.complete_quartets) == (7, (2e7, 6e7), [])
    whole = np.ones(FRAMES, dtype=bool)
    assert dataclasses.replace(read, measured=whole).complete_quartets == [0]
    assert changed(read, cycle_length=4).complete_quartets == [0]
    assert changed(read, measured=whole, cycle_length=None).cycle == 7
    mixed = recording(frequencies_hz=np.array([2e7, 2e7, 2e7, 6e7, 6e7, 6e7, 6e7]), cycle_length=4)[
        0
    ]
    assert mixed.complete_quartets == []


def test_other_layouts_refuse_several_frequencies(tmp_path):
    """They have one place for it."""
    sequence = recording(
        distortion=None, shifts=np.array([0, np.pi, np.pi / 2, 3 * np.pi / 2, 0, np.pi, np.pi / 2])
    )[0]
    with pytest.raises(UsageError, match="frequencies_hz"):
        write("ftorf", tmp_path / "seq", sequence)
    assert not any(tmp_path.iterdir())
