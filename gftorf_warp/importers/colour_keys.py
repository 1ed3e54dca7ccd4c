"""Keys of a colour camera beside the ToF camera: its images, times, lens and poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from ..data.poses import interpolated, rigid
from ..data.resources import Need, require
from ..data.sequence import ColourCamera
from ..errors import InputError
from . import camera_keys, pose_keys
from .colour_images import BALANCES, ENCODINGS, is_picture, read_colour, reduced
from .image_order import matching
from .imported import Notes
from .keys import Key, Settings
from .text_files import numbers, read_rows
from .timing import UNITS

ROWS = ((1.0, 0.0, 0.0, 0.05), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
POSES = "colour.poses"
KEYS = (
    Key(
        name="colour.files",
        kind=str,
        about="images of the colour camera in the recording's folder: PNG, TIFF, EXR, or raw files "
        "of a camera such as DNG",
        example="colour/*.png",
    ),
    Key(
        name="colour.encoding",
        kind=str,
        about="what numbers of PNG and TIFF are",
        example="srgb",
        choices=ENCODINGS,
    ),
    Key(
        name="colour.white_balance",
        kind=str,
        about="of raw files: as the camera set it, of daylight, or none",
        example="camera",
        default="camera",
        choices=BALANCES,
    ),
    Key(
        name="colour.reduce",
        kind=int,
        about="take the mean of so many by so many pixels",
        example=4,
        default=1,
        least=1,
    ),
    Key(
        name="colour.rate_hz",
        kind=float,
        about="colour images per second, evenly [Hz]",
        example=30.0,
        above=0.0,
        unless=("colour.time_file",),
    ),
    Key(
        name="colour.delay_s",
        kind=float,
        about="from raw frame 0 to the first image, with rate_hz [s]",
        example=0.0,
        default=0.0,
    ),
    Key(
        name="colour.time_file",
        kind=str,
        about="text file with the time of every colour image in its first column",
        example="colour_times.csv",
    ),
    Key(
        name="colour.time_unit",
        kind=str,
        about="unit of these times",
        example="s",
        default="s",
        choices=tuple(UNITS),
    ),
    Key(
        name="colour.time_start_s",
        kind=float,
        about="time in that file at which raw frame 0 was taken [s]",
        example=12.5,
    ),
    Key(
        name="colour.tof_from_colour",
        kind=float,
        about="4x4 matrix from the colour camera's coordinates to the ToF camera's [m]; with poses "
        "of the colour camera alone, it gives those of the ToF camera",
        example=ROWS,
        shape=(4, 4),
        unless=(f"{POSES}.file",),
    ),
    *camera_keys.camera_keys("colour", "colour camera", needed=False),
    *pose_keys.pose_keys(POSES, "colour camera"),
)


def files_of(settings: Settings, source: Path) -> list[Path]:
    """Files of the colour images in their natural order; none if the keys name none.

    Raises:
        InputError: If no file matches, or one lies outside the recording's folder.
    """
    if not settings["colour.files"]:
        return []
    root = source if source.is_dir() else source.parent
    return matching(root, settings["colour.files"], settings, "colour.files")


def needed_keys(settings: Settings, files: list[Path]) -> list[str]:
    """Keys without which these colour images cannot be used; none if there are no files.

    Raises:
        InputError: If other keys of the table are given, and no files.
    """
    settings.refuse_without("colour.files")
    lens = [] if settings["colour.file"] else [f"colour.{name}" for name in camera_keys.PINHOLE]
    encoding = ["colour.encoding"] if any(map(is_picture, files)) else []
    start = ["colour.time_start_s"] if settings["colour.time_file"] else []
    others = ["colour.rate_hz", *start, "colour.tof_from_colour", *lens]
    return [*encoding, *others, *pose_keys.needed_keys(settings, POSES)] if files else []


def colour_of(
    settings: Settings,
    source: Path,
    notes: Notes,
    times: Float[np.ndarray, "F"],
    tof_from_world: Float[np.ndarray, "F 4 4"] | None,
) -> tuple[ColourCamera, Float[np.ndarray, "F 4 4"] | None]:
    """The colour camera, and the poses of the ToF camera, which may follow from it.

    Args:
        settings: Values of ``KEYS``.
        source: The recording, a folder or file.
        notes: What was understood is added.
        times: Time of each raw frame [s].
        tof_from_world: Poses of the ToF camera; None: not given.

    Raises:
        UsageError, InputError: If keys are missing or unusable, or a file is damaged.
        ResourceError: If the images do not fit into memory.
    """
    files = files_of(settings, source)
    if not files:
        return ColourCamera(), tof_from_world
    settings.require(*needed_keys(settings, files))
    taken = _times(settings, source, notes, len(files))
    frames, chosen = _nearest(times, taken, notes)
    images, (height, width) = _images(settings, [files[k] for k in chosen], notes)
    lens = camera_keys.intrinsics_of(settings, notes, width, "colour", root=source, height=height)
    if lens.distortion is not None:
        why = f"a capture has no distortion of colour images, found {lens.distortion}"
        raise settings.wrong("colour.distortion", why, "undistort the colour images first")
    root = source if source.is_dir() else source.parent
    images_at = taken, [path.relative_to(root).as_posix() for path in files]
    poses, tof_from_world = _poses(settings, source, notes, times, images_at, tof_from_world)
    poses[frames] = poses[len(times) :][chosen]
    share = 1 / settings["colour.reduce"]
    camera = ColourCamera(
        images=dict(zip(frames.tolist(), images, strict=True)),
        intrinsics=lens.scaled(share, share),
        camera_from_world=poses[: len(times)],
    )
    return camera, tof_from_world


def _images(
    settings: Settings, files: list[Path], notes: Notes
) -> tuple[list[Float[np.ndarray, "h w 3"]], tuple[int, int]]:
    """Images, reduced, of files of one size, and that size (rows, columns)."""
    encoding = settings["colour.encoding"] or ENCODINGS[0]
    balance, factor = settings["colour.white_balance"], settings["colour.reduce"]
    images: list[np.ndarray] = []
    size = None
    for path in files:
        image = read_colour(path, encoding, balance)
        size = size or image.shape[:2]
        if image.shape[:2] != size:
            why = f"expected {size} as in {files[0].name}, found {image.shape[:2]}"
            raise InputError("another size", where=path, why=why, fix="export one size")
        if factor > min(size):
            why = f"images of {size[1]}x{size[0]} cannot be reduced by {factor}"
            raise settings.wrong("colour.reduce", why, "choose a smaller number")
        images.append(reduced(image, factor))
        if len(images) == 1:
            need = Need(memory=float(images[0].nbytes) * len(files))
            require(need, path, "raise colour.reduce, or name fewer images by colour.files")
    assert size is not None
    kind = "raw, in linear sRGB primaries, without black level, white balance " + balance
    kind = f"{encoding} numbers" if is_picture(files[0]) else kind
    kind = "linear" if files[0].suffix.lower() == ".exr" else kind
    text = f"colour: {len(images)} images like {files[0].name}, {size[1]}x{size[0]}, {kind}"
    notes.understood.append(f"{text}{f', reduced by {factor}' if factor > 1 else ''}")
    return images, size


def _times(settings: Settings, source: Path, notes: Notes, count: int) -> Float[np.ndarray, "C"]:
    """Time of each of C colour images since raw frame 0 [s], increasing."""
    path = settings.file("colour.time_file", source)
    if path is None:
        rate, delay = settings["colour.rate_hz"], settings["colour.delay_s"]
        notes.understood.append(f"colour: {rate:g} images per second, the first at {delay:g} s")
        return delay + np.arange(count) / rate
    unit = settings["colour.time_unit"]
    stored = np.array([numbers(path, n, words[:1])[0] for n, words in read_rows(path)])
    taken = stored * UNITS[unit] - settings["colour.time_start_s"]
    if len(taken) != count or (np.diff(taken) <= 0).any():
        why = f"expected {count} increasing times, one for each image, found {len(taken)} in {path}"
        raise settings.wrong("colour.time_file", why, "complete or sort the file")
    notes.understood.append(f"colour: times in {path.name} in {unit}")
    return taken


def _nearest(
    times: Float[np.ndarray, "F"], taken: Float[np.ndarray, "C"], notes: Notes
) -> tuple[Int[np.ndarray, "S"], list[int]]:
    """Raw frames that get an image, and the image of each: the nearest in time, none that is more
    than a raw frame away from the recording.
    """
    period = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    best: dict[int, int] = {}
    for k, time in enumerate(taken.tolist()):
        frame = int(np.abs(times - time).argmin())
        away = abs(times[frame] - time)
        inside = times[0] - period <= time <= times[-1] + period
        if inside and (frame not in best or away < abs(times[frame] - taken[best[frame]])):
            best[frame] = k
    if not best:
        why = f"images are from {taken[0]:.6g} to {taken[-1]:.6g} s, raw frames from 0 to "
        fix = "correct the times of the colour images"
        raise InputError("no colour", where="colour.files", why=f"{why}{times[-1]:.6g} s", fix=fix)
    frames, chosen = np.array(sorted(best)), [best[frame] for frame in sorted(best)]
    if len(chosen) < len(taken):
        left = len(taken) - len(chosen)
        notes.uncertain.append(
            f"{left} colour images are left out: no raw frame of their own is near"
        )
    away = np.abs(times[frames] - taken[chosen]).max()
    if away > 0:
        text = f"colour images are up to {away * 1e3:.3g} ms away from their raw frames"
        notes.uncertain.append(f"{text}, whose times they get")
    return frames, chosen


def _poses(
    settings: Settings,
    source: Path,
    notes: Notes,
    times: Float[np.ndarray, "F"],
    images: tuple[Float[np.ndarray, "C"], list[str]],
    tof_from_world: Float[np.ndarray, "F 4 4"] | None,
) -> tuple[Float[np.ndarray, "N 4 4"], Float[np.ndarray, "F 4 4"] | None]:
    """Poses of the colour camera at all F raw frames and then at its C images, and those of the ToF
    camera.
    """
    taken, names = images
    relative = settings["colour.tof_from_colour"]
    matrix = None if relative is None else np.array(relative)
    if matrix is not None and not rigid(matrix[None]).all():
        why = f"expected a rotation and a translation, found {matrix.tolist()}"
        raise settings.wrong("colour.tof_from_colour", why, "give a 4x4 matrix in metres")
    at_images = pose_keys.poses_of(settings, source, notes, taken, 1, names, POSES)
    both = np.concatenate([times, taken])
    if at_images is not None:
        poses = np.linalg.inv(interpolated(both, taken, np.linalg.inv(at_images)))
        if tof_from_world is None and matrix is not None:
            notes.understood.append("poses: those of the colour camera by colour.tof_from_colour")
            if times[0] < taken[0] or times[-1] > taken[-1]:
                text = "raw frames before the first and after the last colour image have its pose"
                notes.uncertain.append(text)
            tof_from_world = matrix @ poses[: len(times)]
        return poses, tof_from_world
    assert matrix is not None
    notes.understood.append("colour: fixed to the ToF camera by colour.tof_from_colour")
    tof = np.tile(np.eye(4), (len(times), 1, 1)) if tof_from_world is None else tof_from_world
    moved = np.linalg.inv(interpolated(both, times, np.linalg.inv(tof)))
    return np.linalg.inv(matrix) @ moved, tof_from_world
