"""A sweep as a TOML file of scenes, presets, settings and seeds, and its jobs."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from ..data.texts import read_toml
from ..errors import InputError, UsageError
from ..evaluate.metrics import PROTOCOLS
from ..recon import presets
from ..sim.scenes import SCENES
from ..sim.settings import SimSettings
from ..similar import did_you_mean

NAMED = "expected a name of letters, digits and -_.+"
PLAIN = "plain"  # name of the row without changes
RANDOM = re.compile(r"random-\d+")
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]*")
KINDS: dict[str, tuple[type, str]] = {
    "scenes": (list, "a list of names of scenes and of folders"),
    "presets": (list, "a list of names of presets"),
    "seeds": (list, "a list of whole numbers"),
    "one_seed": (list, "a list of presets and rows"),
    "images": (int, "a whole number"),
    "frames": (str, '"all" or "ftorf13"'),
    "simulate": (dict, "a table of options of `gftorf simulate`"),
    "changes": (dict, "a table: name = a list of settings NAME=VALUE"),
    "rows": (dict, "a table: name = a table with a preset and how it differs"),
    "published": (dict, "a table: name = a table of errors by scene"),
}


ROW_KEYS: dict[str, tuple[type, str]] = {
    "preset": (str, "the name of a preset"),
    "input": (str, "auto, quads or phasor"),
    "ablation": (str, "a row of the ablation table"),
    "flow": (str, "auto, file, dis, deepflow or none"),
    "images": (int, "a whole number from 1 on"),
    "changes": (list, "a list of settings NAME=VALUE"),
}


@dataclass(frozen=True, kw_only=True)
class Scene:
    """What is reconstructed."""

    name: str
    """Its name in tables and folders."""
    sequence: Path | None = None
    """Its folder; None: the scene of that name is simulated."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """How scenes are reconstructed: a row of the table."""

    preset: str
    """Name of the preset."""
    changes: tuple[str, ...] = ()
    """Single settings, as ``gftorf reconstruct --set`` takes them."""
    label: str = PLAIN
    """Name of these changes."""
    title: str | None = None
    """Name of a row of ``rows``; None: that of preset and changes."""
    input: str = "auto"
    """What is compared, as ``gftorf reconstruct --input`` takes it."""
    ablation: str | None = None
    """Row of the ablation table, as ``--ablation`` takes it."""
    flow: str | None = None
    """Source of optical flow, as ``--flow`` takes it."""
    images: int | None = None
    """Raw frames that are optimised; None: as many as in the other rows."""

    @property
    def name(self) -> str:
        """Its name in tables and folders."""
        if self.title is not None:
            return self.title
        return self.preset if self.label == PLAIN else f"{self.preset}+{self.label}"

    def arguments(self, images: int | None) -> dict[str, Any]:
        """Arguments of ``reconstruct`` beside preset, seed and device; ``images``: those of all."""
        return {
            "images": self.images or images,
            "input": self.input,
            "ablation": self.ablation,
            "flow": self.flow,
            "changes": self.changes,
        }


@dataclass(frozen=True, kw_only=True)
class Job:
    """A scene to simulate, or a row with one seed to fit to it and to score."""

    scene: Scene
    """What."""
    row: Row | None = None
    """How; None: the scene is simulated."""
    seed: int = 0
    """Seed of the optimiser."""

    @property
    def id(self) -> str:
        """Its name, unlike that of any other job, and the folder of its run in that of all runs."""
        row = "simulated" if self.row is None else f"{self.row.name}-{self.seed}"
        return f"{self.scene.name}/{row}"


@dataclass(frozen=True, kw_only=True)
class Plan:
    """All that a sweep does."""

    scenes: tuple[Scene, ...]
    """What is reconstructed."""
    rows: tuple[Row, ...]
    """How."""
    seeds: tuple[int, ...] = (0,)
    """Of every row that fits something; others have the first one."""
    images: int | None = None
    """Raw frames that every fit optimises; None: as the presets say."""
    frames: str = "all"
    """Raw frames that are scored, as ``gftorf compare --frames`` takes them."""
    simulate: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the recording of all scenes that are simulated."""
    one_seed: frozenset[str] = frozenset()
    """Presets and rows that are fitted with the first seed only."""
    published: Mapping[str, Mapping[str, tuple[float, ...]]] = field(default_factory=dict)
    """Errors [m^2 x 100] of d, or of d and d_ToF, of others on other data, by name and scene, shown
    beside ours."""

    @property
    def recordings(self) -> list[Job]:
        """A job for every scene that is simulated."""
        return [Job(scene=scene) for scene in self.scenes if scene.sequence is None]

    @property
    def fits(self) -> list[Job]:
        """A job for every fit: first all with the first seed."""
        several = tuple(row for row in self.rows if self._has_seeds(row))
        return [
            Job(scene=scene, row=row, seed=seed)
            for seed in self.seeds
            for scene in self.scenes
            for row in (self.rows if seed == self.seeds[0] else several)
        ]

    def _has_seeds(self, row: Row) -> bool:
        return fits(row.preset) and not self.one_seed & {row.preset, row.name}

    def only(self, names: Iterable[str]) -> Plan:
        """The same with some of its rows.

        Raises:
            UsageError: If there is no row of a name.
        """
        names, known = set(names), [row.name for row in self.rows]
        for name in names.difference(known):
            why = did_you_mean(name, known, f"there are {', '.join(known)}")
            fix = "leave --rows out for all of them"
            raise UsageError(f"there is no row {name}", where="--rows", why=why, fix=fix)
        return replace(self, rows=tuple(row for row in self.rows if row.name in names))


def fits(preset: str) -> bool:
    """Whether a preset optimises anything, so that its seed matters."""
    return presets.preset(preset).method.fits


def read_plan(path: str | Path) -> Plan:
    """The plan of a TOML file; folders are relative to it.

    Raises:
        InputError: If the file cannot be read, a key or a name in it is unknown, or a value is not
            what it has to be.
    """
    path = Path(path)
    content = read_toml(path)
    _check_keys(content, KINDS, path)
    for key, value in content.items():
        kind, wanted = KINDS[key]
        if not isinstance(value, kind) or isinstance(value, bool):
            raise _wrong(path, key, f"expected {wanted}, found {value!r}")
    for key in ("scenes",) if content.get("rows") else ("scenes", "presets"):
        if not content.get(key):
            raise _wrong(path, key, f"expected {KINDS[key][1]}, which is not empty")
    seeds = content.get("seeds", [0])
    if not seeds or not all(type(seed) is int and seed >= 0 for seed in seeds):
        raise _wrong(path, "seeds", f"expected whole numbers from 0 on, found {seeds!r}")
    if (images := content.get("images")) is not None and images < 1:
        raise _wrong(path, "images", f"expected at least 1, found {images}")
    if (frames := content.get("frames", "all")) not in PROTOCOLS:
        raise _wrong(path, "frames", f"expected {' or '.join(PROTOCOLS)}, found {frames!r}")
    rows = tuple(_rows(content, path))
    single = content.get("one_seed", [])
    known = [*presets.PRESETS, *(row.name for row in rows)]
    _check_keys(_texts(single, "one_seed", path), known, path, "one_seed: ")
    plan = Plan(
        scenes=tuple(_scene(word, path) for word in _texts(content["scenes"], "scenes", path)),
        rows=rows,
        seeds=tuple(dict.fromkeys(seeds)),
        images=images,
        one_seed=frozenset(single),
        frames=frames,
        simulate=_recording(content.get("simulate", {}), path),
        published=_published(content.get("published", {}), path),
    )
    names = [scene.name for scene in plan.scenes]
    if twice := {name for name in names if names.count(name) > 1}:
        why = f"two are called {', '.join(sorted(twice))}: folders are named by their last part"
        raise _wrong(path, "scenes", why)
    return plan


def _check_keys(given: Iterable[str], known: Iterable[str], path: Path, where: str = "") -> None:
    known = list(known)
    for key in given:
        if key not in known:
            hint = did_you_mean(key, known, f"there are {', '.join(known)}")
            raise _wrong(path, where + key, f"there is no such key: {hint}")


def _wrong(path: Path, key: str, why: str) -> InputError:
    fix = "correct the file; docs/sweep.md explains every key"
    return InputError("this is no plan of a sweep", where=f"{path}: {key}", why=why, fix=fix)


def _texts(values: list, key: str, path: Path) -> list[str]:
    for value in values:
        if not isinstance(value, str):
            raise _wrong(path, key, f"expected texts, found {value!r}")
    return values


def _scene(word: str, path: Path) -> Scene:
    if word in SCENES or RANDOM.fullmatch(word):
        return Scene(name=word)
    folder = path.parent / word
    if not folder.is_dir():
        hint = did_you_mean(word, [*SCENES, "random-0"])
        raise _wrong(path, "scenes", f"{word!r} is neither a scene nor a folder. {hint}".rstrip())
    name = folder.resolve().name
    return Scene(name=name if NAME.fullmatch(name) else "sequence", sequence=folder.resolve())


def _rows(content: Mapping[str, Any], path: Path) -> Iterable[Row]:
    """Every preset as it is, those that fit something with every list of changes, and the rows that
    are described one by one.
    """
    names = _texts(content.get("presets", []), "presets", path)
    _check_keys(names, presets.PRESETS, path, "presets: ")
    changes = content.get("changes", {})
    for label, words in changes.items():
        if not NAME.fullmatch(label) or label == PLAIN:
            raise _wrong(path, f"changes.{label}", NAMED)
        if not isinstance(words, list) or not words:
            raise _wrong(path, f"changes.{label}", "expected a list of settings NAME=VALUE")
        _texts(words, f"changes.{label}", path)
    taken = set()
    for name in dict.fromkeys(names):
        yield Row(preset=name)
        taken.add(name)
        if fits(name):
            for label, words in changes.items():
                yield (row := Row(preset=name, changes=tuple(words), label=label))
                taken.add(row.name)
    for title, given in content.get("rows", {}).items():
        yield _row(title, given, path)
        if title in taken:
            raise _wrong(path, f"rows.{title}", "another row has this name")


def _row(title: str, given: Any, path: Path) -> Row:
    """A row that is described by itself."""
    where = f"rows.{title}"
    if not NAME.fullmatch(title):
        raise _wrong(path, where, NAMED)
    if not isinstance(given, dict) or "preset" not in given:
        raise _wrong(path, where, "expected a table with a preset")
    _check_keys(given, ROW_KEYS, path, f"{where}.")
    for key, value in given.items():
        kind, wanted = ROW_KEYS[key]
        if type(value) is not kind or (isinstance(value, int) and value < 1):
            raise _wrong(path, f"{where}.{key}", f"expected {wanted}, found {value!r}")
    _check_keys([given["preset"]], presets.PRESETS, path, f"{where}.preset: ")
    changes = tuple(_texts(given.get("changes", []), f"{where}.changes", path))
    return Row(**given | {"title": title, "changes": changes})


def _recording(options: Mapping[str, Any], path: Path) -> dict[str, Any]:
    _check_keys(options, (f.name for f in fields(SimSettings)), path, "simulate.")
    return {
        key: tuple(value) if isinstance(value, list) else value for key, value in options.items()
    }


def _published(tables: Mapping[str, Any], path: Path) -> dict[str, dict[str, tuple[float, ...]]]:
    published: dict[str, dict[str, tuple[float, ...]]] = {}
    for name, errors in tables.items():
        where, published[name] = f"published.{name}", {}
        if not isinstance(errors, dict):
            raise _wrong(path, where, "expected a table: scene = error of d, or [d, d_ToF]")
        for scene, given in errors.items():
            numbers = given if isinstance(given, list) else [given]
            if not 1 <= len(numbers) <= 2 or not all(type(x) in (int, float) for x in numbers):
                why = f"expected an error of d, or [d, d_ToF], found {given!r}"
                raise _wrong(path, f"{where}.{scene}", why)
            published[name][scene] = tuple(map(float, numbers))
    return published
