"""Keys of the camera's poses, and the pose of each raw frame that they give."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float

from ..data.poses import interpolated
from .imported import Notes
from .keys import Key, Settings
from .raw_files import natural
from .trajectory_files import FORMS, Trajectory, read_trajectory

DIRECTIONS, AXES = ("world_to_camera", "camera_to_world"), ("opencv", "opengl")
UNSCALED = ("colmap", "nerfstudio")  # reconstructed from pictures: the unit of length is arbitrary


def pose_keys(table: str, who: str) -> tuple[Key, ...]:
    """Keys of the poses of a camera in a table."""
    return (
        Key(
            name=f"{table}.file",
            kind=str,
            about=f"poses of the {who}: images.txt of COLMAP, a TUM trajectory, transforms.json of "
            "nerfstudio, or matrices as .npy or text",
            example="poses.txt",
        ),
        Key(
            name=f"{table}.form",
            kind=str,
            about="form of that file",
            example="tum",
            choices=FORMS,
        ),
        Key(
            name=f"{table}.metres_per_unit",
            kind=float,
            about="length of the file's unit [m]; colmap and nerfstudio do not know it",
            example=1.0,
            above=0.0,
        ),
        Key(
            name=f"{table}.direction",
            kind=str,
            about="of matrices: what they take to what",
            example=DIRECTIONS[0],
            choices=DIRECTIONS,
        ),
        Key(
            name=f"{table}.axes",
            kind=str,
            about="of matrices and tum: camera axes; opencv is x right, y down, z forward, opengl "
            "x right, y up, z backward",
            example="opencv",
            default="opencv",
            choices=AXES,
        ),
        Key(
            name=f"{table}.start_s",
            kind=float,
            about="of tum: time in the file at which raw frame 0 was taken [s]",
            example=1305031102.1758,
        ),
    )


KEYS = pose_keys("poses", "ToF camera")


def needed_keys(settings: Settings, table: str = "poses") -> list[str]:
    """Keys without which the file of poses cannot be used; none if there is no file.

    Raises:
        InputError: If other keys of the table are given, and no file.
    """
    settings.refuse_without(f"{table}.file")
    form = settings[f"{table}.form"]
    by_form = {"tum": "start_s", "matrices": "direction"} | dict.fromkeys(
        UNSCALED, "metres_per_unit"
    )
    names = ["form", *([by_form[form]] if form else [])]
    return [f"{table}.{name}" for name in names] if settings[f"{table}.file"] else []


def poses_of(
    settings: Settings,
    root: Path,
    notes: Notes,
    times: Float[np.ndarray, "F"],
    cycle: int,
    files: list[str] | None,
    table: str = "poses",
) -> Float[np.ndarray, "F 4 4"] | None:
    """Pose of a camera at F times, world to camera [m]; None: no file of poses is named.

    A file with times is interpolated. Of one without, the poses belong to the images that they
    name, or else in their natural order to the times, or to the first of each cycle; between those
    they are interpolated.

    Args:
        settings: Values of :func:`pose_keys`.
        root: The recording; the file is there or beside the TOML file.
        notes: What was understood is added.
        times: Times [s] since raw frame 0.
        cycle: Raw frames of a cycle.
        files: Name of the image of each time; None: an image is not a file.
        table: Table of the keys.

    Raises:
        UsageError, InputError: If keys are missing, or the file does not have these poses.
    """
    path, needed = settings.file(f"{table}.file", root), needed_keys(settings, table)
    if path is None:
        return None
    settings.require(*needed)
    form = settings[f"{table}.form"]
    backward = settings[f"{table}.direction"] == DIRECTIONS[0]
    opengl = settings[f"{table}.axes"] == "opengl"
    trajectory = read_trajectory(path, form, world_to_camera=backward, opengl=opengl)
    metres = settings[f"{table}.metres_per_unit"] or 1.0
    poses, how = _at(settings, table, trajectory, times, cycle, files, path, notes)
    poses[:, :3, 3] *= metres
    axes = f", camera axes {settings[f'{table}.axes']}" if form in ("tum", "matrices") else ""
    notes.understood.append(
        f"{table}: {len(trajectory.camera_to_world)} of {path.name} ({form}{axes}, {metres:g} m "
        f"a unit ({settings.source(f'{table}.metres_per_unit')})), {how}"
    )
    return np.linalg.inv(poses)


def _at(
    settings: Settings,
    table: str,
    trajectory: Trajectory,
    times: Float[np.ndarray, "F"],
    cycle: int,
    files: list[str] | None,
    path: Path,
    notes: Notes,
) -> tuple[Float[np.ndarray, "F 4 4"], str]:
    """Camera to world at each time in the file's unit, and how it was found, in words."""
    poses = trajectory.camera_to_world
    if trajectory.stamps is not None:
        wanted = times + settings[f"{table}.start_s"]
        first, last = trajectory.stamps[[0, -1]]
        if wanted[0] < first or wanted[-1] > last:
            why = (
                f"raw frames are from {wanted[0]:.9g} to {wanted[-1]:.9g} s of {path.name}, which "
            )
            why += f"has poses from {first:.9g} to {last:.9g} s"
            raise settings.wrong(f"{table}.start_s", why, "correct it, or the times")
        return interpolated(wanted, trajectory.stamps, poses), "interpolated"
    names = trajectory.names
    if names is not None:
        chosen = [_named(file, names) for file in files or []]
        present = [n for n in chosen if n is not None]
        if present and len(present) == len(chosen):
            return poses[present], "by the names of images"
        if present and files is not None:
            missing = [file for file, n in zip(files, chosen, strict=True) if n is None]
            why = f"{path.name} has no pose, or several, for {', '.join(missing)[:200]}"
            raise settings.wrong(f"{table}.file", why, "leave these images out, or add their poses")
        poses = poses[sorted(range(len(names)), key=lambda n: natural(names[n]))]
    cycles = -(-len(times) // cycle)
    if len(poses) == len(times):
        return poses.copy(), "one for each, in their order"
    if len(poses) != cycles:
        why = f"expected {len(times)} poses, or one for each of {cycles} cycles, found {len(poses)}"
        raise settings.wrong(f"{table}.file", f"{why} in {path}", "complete the poses")
    notes.uncertain.append(
        f"{path.name} has a pose for each cycle: it is taken as that of its first raw frame, and "
        "the last stays until the end"
    )
    return interpolated(times, times[::cycle], poses), "one for each cycle, interpolated"


def _named(file: str, names: tuple[str, ...]) -> int | None:
    """The image of this name, or else the only one of this name without folders and suffix."""
    if file in names:
        return names.index(file)
    stem = PurePosixPath(file).stem
    alike = [n for n, name in enumerate(names) if PurePosixPath(name).stem == stem]
    return alike[0] if len(alike) == 1 else None
