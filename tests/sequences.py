"""Sequences by flat names of their values, which are also the names of ``sources``."""

import dataclasses

from gftorf_warp.data.sequence import Calibration, ColourCamera, Flow, Intrinsics, Sequence

PINHOLE = ("fx", "fy", "cx", "cy")
PARTS = {  # part of a sequence: (its class, {flat name: name in the part})
    "intrinsics": (Intrinsics, {n: n for n in (*PINHOLE, "distortion")}),
    "calibration": (
        Calibration,
        {
            n: n
            for n in (
                "f_mod_hz",
                "phase_offset",
                "dc_offset",
                "adc_zero",
                "quad_scale",
                "cycle_length",
            )
        }
        | {"sensor": "settings"},
    ),
    "colour": (
        ColourCamera,
        {
            "colour": "images",
            "colour_intrinsics": "intrinsics",
            "colour_from_world": "camera_from_world",
        },
    ),
    "flow": (Flow, {"forward_flow": "forward", "backward_flow": "backward"}),
}
ABOUT = {"sources", "path", "excerpt"}  # where the values are from
NAMES = {f.name for f in dataclasses.fields(Sequence)} - PARTS.keys() - ABOUT
NAMES |= {name for _, names in PARTS.values() for name in names}


def sequence_of(**values):
    """A sequence of values by their flat names; intrinsics of the colour camera also as (fx, fy,
    cx, cy).
    """
    if isinstance(values.get("colour_intrinsics"), tuple):
        values["colour_intrinsics"] = Intrinsics(
            **dict(zip(PINHOLE, values["colour_intrinsics"], strict=True))
        )
    for part, (kind, names) in PARTS.items():
        given = {name: values.pop(name) for name in [*values] if name in names}
        values[part] = kind(**{names[name]: value for name, value in given.items()})
    return Sequence(**values)


def values_of(sequence):
    """The values of a sequence by their flat names, without where they are from."""
    values = {
        name: getattr(sequence, name)
        for name in NAMES
        if hasattr(sequence, name) and name not in PARTS
    }
    for part, (_, names) in PARTS.items():
        values |= {name: getattr(getattr(sequence, part), inner) for name, inner in names.items()}
    return values


def changed(sequence, **values):
    """A sequence with other values, by their flat names."""
    kept = {name: getattr(sequence, name) for name in ABOUT}
    return sequence_of(**kept | values_of(sequence) | values)
