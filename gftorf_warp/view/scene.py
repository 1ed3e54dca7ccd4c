"""What a viewer shows, as arrays: chosen by :class:`Choice`, computed from a :class:`Subject`."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from ..evaluate import pictures
from ..evaluate.panels import CHI_SQUARE_SHOWN
from ..export.moments import Moments
from ..export.points import OPAQUE, grey, world_points
from ..export.splats import colour_harmonics, gaussians_at
from .subject import Subject

SPLATS, POINTS = "splats", "points"
COLOURS = ("distance", "error", "chi-square", "amplitude", "quads")
"""What pictures show and points are coloured by."""
OURS, CLOSED_FORM, TRUTH = "ours, d", "closed form", "truth"
SPLAT_MIN = 1.0 / 255.0  # [1] fainter Gaussians are not sent
APART = 1.15  # distance of clouds beside each other, over their width
WHITE = 99.0  # percentile of the amplitudes that is white
MOST_POINTS = 100_000  # of a cloud, so that playing sends a few MB per raw frame
MOST_CAMERAS = 40  # frusta of a path

Shown = tuple[Float[np.ndarray, "H W"], pictures.Scale]


@dataclass(frozen=True, kw_only=True)
class Choice:
    """What the controls of the viewer are set to."""

    frame: int = 0
    """The raw frame n."""
    shape: str = SPLATS
    """Of ours: ``splats`` or ``points``."""
    colour: str = COLOURS[0]
    """One of ``COLOURS``."""
    beside: bool = True
    """Whether closed form and truth stand beside ours."""
    cameras: bool = True
    """Whether the camera and its path are drawn."""
    pixel: tuple[int, int] = (0, 0)
    """The pixel (y, x) whose quads are drawn."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloud:
    """Coloured points."""

    title: str
    """What they are."""
    points: Float[np.ndarray, "P 3"]
    """In the world [m], where they are drawn."""
    rgb: UInt8[np.ndarray, "P 3"]
    """Colours."""
    pixels: np.ndarray = field(repr=False)
    """(y, x) of the pixel of each, integers [P, 2]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Splats:
    """The Gaussians at one time."""

    centre: Float[np.ndarray, "N 3"]
    """In the world [m]."""
    scale: Float[np.ndarray, "N 3"]
    """Standard deviations [m]."""
    quaternion: Float[np.ndarray, "N 4"]
    """Orientation wxyz, of unit length."""
    opacity: Float[np.ndarray, "N"]
    """At the peak [1]."""
    rgb: Float[np.ndarray, "N 3"]
    """Colours in [0, 1]."""


def colours_of(subject: Subject) -> list[str]:
    """Those of ``COLOURS`` that can be shown."""
    explained = subject.residuals
    known = {
        "error": subject.recording.truth is not None,
        "chi-square": explained is not None and explained.noisy,
    }
    return [name for name in COLOURS if known.get(name, True)]


def pictures_of(subject: Subject, n: int, colour: str) -> dict[str, Shown]:
    """The pictures of a raw frame with their scales, by title; those that are unknown are left
    out.
    """
    distances = distances_of(subject, n)
    if colour == "distance":
        scale = subject.recording.distance_scale
        return {title: (image, scale) for title, image in distances.items()}
    if colour == "error":
        return _errors(subject, distances)
    if colour == "chi-square":
        return _chi_square(subject, n)
    if colour == "amplitude":
        image = subject.recording.amplitude(n)
        if image is None:
            return {}
        return {"measured amplitude": (image, pictures.amplitude_scale([image]))}
    return _quads(subject, n)


def _errors(subject: Subject, distances: dict[str, Float[np.ndarray, "H W"]]) -> dict[str, Shown]:
    if TRUTH not in distances:
        return {}
    truth, scale = distances.pop(TRUTH), subject.recording.error_scale
    return {f"error of {title}": (np.abs(d - truth), scale) for title, d in distances.items()}


def _chi_square(subject: Subject, n: int) -> dict[str, Shown]:
    image = subject.chi_square(n)
    if image is None:
        return {}
    low, high = np.log10(CHI_SQUARE_SHOWN)
    scale = pictures.Scale(low=low, high=high, colours="magma", unit="power of ten")
    full = _resized(np.log10(np.maximum(image, CHI_SQUARE_SHOWN[0])), subject)
    return {f"chi-square of quartet {n // subject.sequence.cycle}": (full, scale)}


def _quads(subject: Subject, n: int) -> dict[str, Shown]:
    sequence, scale = subject.sequence, subject.recording.quad_scale
    if not sequence.measured[n]:
        return {}
    measured = sequence.quads[n]
    shift = f"shift {np.degrees(sequence.shifts[n]):.0f}\N{DEGREE SIGN}"
    shown: dict[str, Shown] = {f"measured quad, {shift}": (measured, scale)}
    if subject.run is not None:
        rendered = subject.rendered(n)["slots"][n % sequence.cycle]
        shown["rendered quad"] = rendered, scale
        apart = measured - rendered
        shown["measured minus rendered"] = apart, pictures.signed_scale([apart])
    return shown


def distances_of(subject: Subject, n: int) -> dict[str, Float[np.ndarray, "H W"]]:
    """All distances [m] that are known at a raw frame, by title."""
    ours, recorded = subject.ours(n), subject.recording
    by_title = {
        CLOSED_FORM: recorded.closed_form(n),
        OURS: None if ours is None else ours["distance"],
        TRUTH: recorded.true_distance(n),
    }
    return {title: distance for title, distance in by_title.items() if distance is not None}


def _drawn_distances(subject: Subject, choice: Choice) -> dict[str, Float[np.ndarray, "H W"]]:
    """Distances [m] of the shapes that are drawn, by title."""
    distances = distances_of(subject, choice.frame)
    everything = choice.beside or subject.run is None
    return {title: d for title, d in distances.items() if everything or title == OURS}


def clouds(subject: Subject, choice: Choice) -> list[Cloud]:
    """Points of ours if they are wanted as points, of closed form and truth beside them."""
    n, camera, drawn = choice.frame, subject.recording.camera(choice.frame), []
    for title, distance in _drawn_distances(subject, choice).items():
        if title == OURS and choice.shape == SPLATS:
            continue
        seen = np.isfinite(distance) & (distance > 0) & _every(distance)
        if title == OURS and (ours := subject.ours(n)) is not None:
            seen &= ours["opacity"] >= OPAQUE
        points = world_points(distance, camera, seen).T + _displacement(subject, title)
        rgb = cloud_colours(subject, n, choice.colour, title)[seen]
        given = {"points": points.astype(np.float32), "rgb": rgb, "pixels": np.argwhere(seen)}
        drawn.append(Cloud(title=title, **given))
    return drawn


def marks(subject: Subject, choice: Choice) -> dict[str, Float[np.ndarray, "3"]]:
    """Where the chosen pixel is in every shape [m], by title; unknown distances have no mark."""
    camera, (y, x) = subject.recording.camera(choice.frame), choice.pixel
    ray = camera.rays()[y, x].numpy()
    distances = {title: float(d[y, x]) for title, d in _drawn_distances(subject, choice).items()}
    return {
        title: camera.centre + distance * ray + _displacement(subject, title)
        for title, distance in distances.items()
        if distance > 0  # NaN is not
    }


def titles(subject: Subject, choice: Choice) -> dict[str, Float[np.ndarray, "3"]]:
    """Where the title of every shape is written [m]: above its middle, at the farthest distance."""
    camera, far = subject.recording.camera(0), subject.recording.distance_scale.high
    _, down, forward = camera.camera_from_world[:3, :3]
    above = camera.centre + far * (forward - 0.6 * camera.height / camera.fy * down)
    return {
        title: above + _displacement(subject, title) for title in _drawn_distances(subject, choice)
    }


def _displacement(subject: Subject, title: str) -> Float[np.ndarray, "3"]:
    """Displacement [m] of a shape, so that it stands beside ours."""
    steps = {OURS: 0, CLOSED_FORM: 0 if subject.run is None else -1, TRUTH: 1}
    right = subject.recording.camera(0).camera_from_world[0, :3]
    return steps[title] * APART * subject.recording.width * right


def _every(image: Float[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Every k-th row and column, with the smallest k for at most ``MOST_POINTS`` pixels."""
    step = int(np.ceil(np.sqrt(image.size / MOST_POINTS)))
    chosen = np.zeros(image.shape, dtype=bool)
    chosen[::step, ::step] = True
    return chosen


def cloud_colours(subject: Subject, n: int, colour: str, title: str) -> UInt8[np.ndarray, "H W 3"]:
    """RGB of the pixels of a cloud: of its own picture, else of the only one, else the measured
    amplitude.
    """
    shown = pictures_of(subject, n, colour)
    picture = shown.get(title) or shown.get(f"error of {title}")
    if picture is None and title == OURS and colour in ("chi-square", "quads") and shown:
        picture = next(iter(shown.values()))
    if picture is not None:
        return pictures.colour_mapped(picture[0].astype(np.float32), picture[1])
    image = subject.recording.amplitude(n)
    if image is None:
        return np.full((*subject.sequence.quads[n].shape, 3), 160, np.uint8)
    return grey(image, float(np.percentile(image, WHITE)))


@torch.no_grad()
def splats(subject: Subject, choice: Choice) -> Splats | None:
    """The Gaussians at the raw frame; None if there are none or points are wanted."""
    run, n = subject.run, choice.frame
    if run is None or not subject.has_gaussians or choice.shape != SPLATS:
        return None
    camera = subject.recording.camera(n)
    time = float(subject.sequence.times[n])
    moments = Moments(run=run, times=[time], frames=[n], cameras=[camera])
    gaussians = gaussians_at(moments, 0, colour_harmonics(moments, "reflectivity"))
    seen = gaussians.opacity > SPLAT_MIN
    gaussians = gaussians.map(lambda tensor: tensor[seen])
    assert gaussians.colour_sh is not None, "harmonics of what is shown are its colour"
    turn = torch.nn.functional.normalize(gaussians.quaternion, dim=1)
    return Splats(
        centre=gaussians.mean.numpy(),
        scale=gaussians.scale.numpy(),
        quaternion=turn.numpy(),
        opacity=gaussians.opacity.numpy(),
        rgb=_splat_colours(subject, choice, gaussians.mean),
    )


def _splat_colours(
    subject: Subject, choice: Choice, centre: torch.Tensor
) -> Float[np.ndarray, "N 3"]:
    """Colours of the pixels that centres are seen in; grey outside of the image."""
    n, camera = choice.frame, subject.recording.camera(choice.frame)
    if choice.colour == "distance":
        distance = np.linalg.norm(centre.numpy() - camera.centre, axis=1).astype(np.float32)
        return pictures.colour_mapped(distance[None], subject.recording.distance_scale)[0] / 255.0
    picture = cloud_colours(subject, n, choice.colour, OURS)
    at = camera.project(centre.double()).nan_to_num(-1.0).floor().clamp(-1, 1e6).long().numpy()
    inside = ((at >= 0) & (at < (camera.width, camera.height))).all(axis=1)
    rgb = np.full((len(at), 3), pictures.UNKNOWN_GREY, np.uint8)
    rgb[inside] = picture[at[inside, 1], at[inside, 0]]
    return rgb / 255.0


def pixel_on_ray(
    candidates: list[Cloud], origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]
) -> tuple[int, int] | None:
    """The pixel (y, x) of the point that a ray passes nearest to, seen from its origin; None if
    none is within two degrees.
    """
    best, pixel = np.cos(np.radians(2.0)), None
    for cloud in candidates:
        if not len(cloud.points):
            continue
        apart = cloud.points - origin
        cosine = apart @ direction / np.maximum(np.linalg.norm(apart, axis=1), 1e-9)
        k = int(cosine.argmax())
        if cosine[k] > best:
            best, pixel = cosine[k], (int(cloud.pixels[k, 0]), int(cloud.pixels[k, 1]))
    return pixel


def path_of(subject: Subject) -> list[int]:
    """Raw frames whose cameras are drawn beside that of now: none if the camera rests, else up to
    ``MOST_CAMERAS``.
    """
    poses = subject.sequence.camera_from_world
    if np.allclose(poses, poses[:1], atol=1e-6):
        return []
    count = min(subject.frames, MOST_CAMERAS)
    return sorted({*np.linspace(0, subject.frames - 1, count).astype(int).tolist()})


def _resized(image: Float[np.ndarray, "h w"], subject: Subject) -> Float[np.ndarray, "H W"]:
    """An image at the size of the sequence, by its nearest pixels."""
    height, width = subject.sequence.quads[0].shape
    rows = np.arange(height) * image.shape[0] // height
    columns = np.arange(width) * image.shape[1] // width
    return image[np.ix_(rows, columns)]
