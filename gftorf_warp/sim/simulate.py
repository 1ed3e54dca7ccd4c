"""Simulate a named scene: a sequence on disk, with its ground truth and a data card."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..data import resources
from ..data.contact_sheet import contact_sheet
from ..data.files import atomic_write
from ..data.read import read, read_truth
from ..data.write import write
from ..errors import UsageError
from ..similar import did_you_mean
from .card import outcome_card, settings_card
from .checks import (
    check_cameras,
    check_clearance,
    check_engine,
    check_format,
    check_numbers,
    check_size,
)
from .closed_form_errors import Errors, closed_form_errors, ladder_table
from .gaussian_cover import splats_of
from .ladder import NAMES, resolved
from .random_scene import PREFIX
from .record import Progress, longest_times, record
from .resume import cached_images, needs_recording, set_aside
from .scene import overridden
from .scene_file import read_scene
from .scenes import SCENES, Scene, named_scene
from .settings import ResolvedSettings, SimSettings, refuse


def simulate(
    scene: str | Scene,
    out: str | Path,
    settings: SimSettings = SimSettings(),
    *,
    device: str = "cpu",
    fresh: bool = False,
    progress: Progress | None = None,
    **changes: Any,
) -> Path:
    """Record a moving scene with an asynchronous C-ToF sensor and write it as a sequence.

    Each raw frame is the quad of its shift and frequency at its own time, with a pose if the camera
    moves; its truth is the analytic distance along each pixel's centre ray. A colour camera adds an
    image per quartet. The folder appears when it is complete; if it exists with the same settings,
    it is not changed. After an interruption the same call continues at the next raw frame: finished
    images are in OUT.partial, and the final bytes are the same.

    Args:
        scene: Name of a scene, see ``SCENES``; ``random``, drawn from the seed, or ``random-N``; a
            TOML file of a scene; or a scene.
        out: Folder to write.
        settings: How the scene is recorded.
        device: Where engine mesh traces; engine gaussian renders on the CPU.
        fresh: Whether another sequence in ``out`` is renamed to ``out-old-1``, instead of being an
            error, and an unfinished one restarted.
        progress: Called with (raw frames done, raw frames in all).
        changes: Fields of ``settings`` with other values: ``simulate("arc", "arc", frames=16)``.

    Returns:
        The folder.

    Raises:
        UsageError: If settings contradict each other or the scene, the format cannot express the
            sensor, ``out`` or OUT.partial holds something else, or the folder cannot be written to.
        ResourceError: If memory or disk cannot hold the recording.
        BusyError: If another process records the same sequence.
        InputError: If a TOML file does not describe a scene.

    >>> from gftorf_warp import simulate
    >>> folder = simulate("demo", "demo", frames=8, size=(24, 18))
    >>> (folder / "README.md").read_text().splitlines()[0]
    '# demo: simulated C-ToF sequence'
    """
    settings = replace(settings, **changes)
    lost = settings.paths is not None and (settings.bounces, settings.level) == (None, None)
    why, fix = "direct light needs none", "add --engine mesh --bounces 3, or leave --paths out"
    refuse(lost, ("random paths of nothing", "--paths"), why, fix)
    requested = scene_of(scene, settings.overrides, settings.seed)
    settings = replace(settings, overrides=())
    recorded, used = resolved(requested, settings)
    check_numbers(recorded)
    _check_resources(recorded, used, Path(out))
    check_engine(recorded, used, device)
    check_format(recorded, used)
    check_cameras(recorded, longest_times(recorded, used))
    check_size(recorded, used)
    check_clearance(recorded, longest_times(recorded, used))
    _check_covers(recorded, used, Path(out))
    card = settings_card(requested, settings)
    out = Path(out).absolute() if fresh else Path(out)
    if not needs_recording(out, card, fresh=fresh):
        return out
    with cached_images(out, card, fresh=fresh) as cached:
        recording = record(recorded, used, device=device, progress=progress, cached=cached)
        if fresh:
            set_aside(out)
        title = card.partition("\n")[0].removeprefix("# ")
        sheet = contact_sheet(recording.sequence, recording.truth, title)
        readme = card + outcome_card(recording)
        write(used.format, out, recording.sequence, recording.truth, readme=readme, sheet=sheet)
    return out


def _check_resources(scene: Scene, settings: ResolvedSettings, out: Path) -> None:
    """Raise a ResourceError if memory or disk cannot hold the recording."""
    pixels, rays = math.prod(settings.size), scene.subsamples**2
    traced = settings.engine == "mesh"
    need = resources.to_simulate(settings.frames, pixels, rays, traced=traced)
    resources.require(need, out, "use a smaller --size or fewer --frames")


def _check_covers(scene: Scene, settings: ResolvedSettings, out: Path) -> None:
    """Raise a ResourceError if memory cannot hold the splats on moving bodies, whose number depends
    on the focal length in pixels, and not on the height of the image.
    """
    if settings.engine == "mesh":
        return
    times = longest_times(scene, settings)
    centres = np.array([scene.camera(time=float(time)).centre for time in times])
    camera = scene.camera(settings.size).finer(scene.subsamples)
    moving = [body for body in scene.bodies if body.moves]
    splats = sum(splats_of(body, camera, times, centres) for body in moving)
    resources.require(resources.to_cover(splats), out, "use a smaller --size, or --engine mesh")


def simulate_ladder(
    scene: str | Scene,
    out: str | Path,
    settings: SimSettings = SimSettings(),
    *,
    device: str = "cpu",
    fresh: bool = False,
    progress: Progress | None = None,
) -> dict[str, Errors]:
    """Record a scene at all levels, into OUT/sync, OUT/L0, ...; errors in OUT/ladder.md.

    Arguments and errors are those of :func:`simulate`; progress is that of each level in turn.
    Levels that exist already with the same settings are left as they are.

    Returns:
        Errors of the closed form by name of the level.
    """
    out, rows = Path(out), {}
    for name in NAMES:
        at_level = replace(settings, level=name)
        path = simulate(scene, out / name, at_level, device=device, fresh=fresh, progress=progress)
        sequence = read(path)
        rows[name] = closed_form_errors(sequence, read_truth(sequence))
    title = scene if isinstance(scene, str) else scene.name
    lines = "\n".join(f"    {line}" for line in ladder_table(rows))
    text = f"# {title}: what each level of the ladder costs\n\n{lines}\n"
    atomic_write(out / "ladder.md", text.encode())
    return rows


def scene_of(scene: str | Scene, overrides: Iterable[str] = (), seed: int = 0) -> Scene:
    """A scene by its name or file, with single settings changed; as for :func:`simulate`.

    ``seed`` decides what ``random`` is, and nothing else.

    Raises:
        UsageError: If there is no such scene, or a setting cannot be changed so.
        InputError: If a TOML file does not describe a scene.
    """
    if isinstance(scene, Scene):
        return overridden(scene, overrides)
    if scene.endswith(".toml"):
        return overridden(read_scene(scene), overrides)
    chosen = named_scene(scene, seed)
    if chosen is None:
        others = "take one of these, `--list` describes them, or a file that ends in .toml"
        named = *SCENES, PREFIX, f"{PREFIX}-N"
        why, fix = f"the named scenes are {', '.join(named)}", did_you_mean(scene, named, others)
        raise UsageError(f"there is no scene named {scene!r}", where="SCENE", why=why, fix=fix)
    return overridden(chosen, overrides)
