"""What limits ``gftorf render`` on a machine: its memory, its disk, those that write, or the
rendering.

    python benchmarks/files.py FOLDER .. [--images N ..] [--run RUN] [--device cpu|cuda] [--rounds
    R] [--no-warm]
                               [--pictures P ..]

Distance and four quads of 320x240, 1.84 MB per image, below each folder, which may be on a disk or
in memory. Rows: ``pages`` are plain files of as many bytes from one thread for each of six files,
flushed, then removed: the first round of them takes memory that a virtual machine may never have
used, which can cost more than all that follows. ``past memory`` is the same by O_DIRECT: what the
disk does. ``written`` is what the command does with images that cost nothing, ``rendered`` the
command itself with RUN, from the first block on, flush included, as its progress line has it; in
brackets the rate of all of it, with what comes before. Pages are used just before every row, unless
--no-warm.

All this is of ``--arrays``. With --pictures it is of pictures, ``written`` and ``rendered`` by so
many processes each, 0: by threads. Files are 2.24 MB per image, GB/s are of what is rendered.
"""

from __future__ import annotations

import argparse
import logging
import mmap
import os
import shutil
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from gftorf_warp.evaluate import previews, processes, stored, views, writers
from gftorf_warp.recon.run import Run

HEIGHT, WIDTH = 240, 320
CHANNELS = {
    "distance": ("distance", "opacity"),
    "quads": ("quad_000", "quad_180", "quad_090", "quad_270"),
}
PLANES = 6
IMAGE = 4 * PLANES * HEIGHT * WIDTH  # [bytes]
CALL = 32 * 4 * HEIGHT * WIDTH  # [bytes] that a thread writes at a time


def plain(out: Path, images: int, direct: int) -> None:
    """Six files of as many bytes as the images have, a thread each."""
    block = mmap.mmap(-1, CALL)
    block[:] = np.random.default_rng(0).bytes(CALL)

    def fill(number: int) -> None:
        file = os.open(out / str(number), os.O_CREAT | os.O_WRONLY | direct, 0o600)
        for _ in range(-(-images * IMAGE // (PLANES * CALL))):
            os.write(file, block)
        os.fsync(file)
        os.close(file)

    with ThreadPoolExecutor(PLANES) as threads:
        list(threads.map(fill, range(PLANES)))


def memory() -> np.ndarray:
    """Random images [K, P, H, W], as many as a renderer reserves."""
    shape = stored.HELD + 1, PLANES, HEIGHT, WIDTH
    ring = np.frombuffer(mmap.mmap(-1, shape[0] * IMAGE), dtype=np.float32).reshape(shape)
    ring[:] = np.random.default_rng(0).random(shape, dtype=np.float32)
    return ring


def series(images: int, ring: np.ndarray) -> Iterator[dict[str, dict[str, np.ndarray]]]:
    """Images that are there already, in memory that goes round."""
    for k in range(images):
        planes = iter(ring[k % len(ring)])
        yield {
            name: {channel: next(planes) for channel in channels}
            for name, channels in CHANNELS.items()
        }


def written(out: Path, images: int, ring: np.ndarray) -> None:
    """The command without a renderer."""
    for name in CHANNELS:
        (out / name).mkdir()
    stored.store_all(out, CHANNELS, series(images, ring), (images, HEIGHT, WIDTH))


def pictured(out: Path, images: int, ring: np.ndarray) -> float:
    """The command without a renderer, of pictures."""
    (first,), seen = series(1, ring), []
    scales = {name: previews.preview_scale(name, [channels]) for name, channels in first.items()}
    for name in CHANNELS:
        (out / name).mkdir()
    writers.write_all(
        out,
        scales,
        series(images, ring),
        images,
        lambda k, _: seen.append((k, time.perf_counter())),
    )
    return each_of(seen)


def each_of(seen: list[tuple[int, float]]) -> float:
    """Seconds per image from the first progress on."""
    (first, early), (last, late) = seen[0], seen[-1]
    return (late - early) / (last - first)


def rendered(out: Path, images: int, run: Run, arrays: bool = True) -> float:
    """The command; seconds per image from the first progress on."""
    sequence, seen = run.sequence(), []
    seconds = [float(t) for t in np.linspace(sequence.times[0], sequence.times[-1], images)]
    views.render_to_folder(
        run,
        out,
        tuple(CHANNELS),
        seconds,
        arrays=arrays,
        plain=True,
        progress=lambda k, _: seen.append((k, time.perf_counter())),
    )
    return each_of(seen)


def by(count: int, way: Callable[[Path, int], float]) -> Callable[[Path, int], float]:
    """A way in which so many processes write."""

    def forced(out: Path, images: int) -> float:
        processes.useful = lambda _: count
        return way(out, images)

    return forced


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, nargs="+")
    parser.add_argument("--images", type=int, nargs="+", default=[2000])
    parser.add_argument("--run", type=Path)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--pictures", type=int, nargs="+")
    parser.add_argument("--no-warm", action="store_true")
    options = parser.parse_args()
    logging.basicConfig()
    stored.LOG.setLevel(logging.DEBUG)  # it says which file a disk does not take past memory
    run = options.run and Run.open(options.run, options.device)
    ring = memory()
    ways: dict[str, Callable[[Path, int], float | None]] = {
        "pages": lambda out, n: plain(out, n, 0),
        "past memory": lambda out, n: plain(out, n, stored.DIRECT),
        "written": lambda out, n: written(out, n, ring),
    }
    if run:
        ways["rendered"] = lambda out, n: rendered(out, n, run)
    if options.pictures is not None:
        ways = {
            f"written by {p}": by(p, lambda out, n: pictured(out, n, ring))
            for p in options.pictures
        }
        if run:
            ways |= {
                f"rendered by {p}": by(p, lambda out, n: rendered(out, n, run, False))
                for p in options.pictures
            }
    for folder in options.folder:
        for images in options.images:
            for name, way in ways.items():
                for number in range(options.rounds):
                    out = folder / f"gftorf-files-{os.getpid()}"
                    if name != "pages" and not options.no_warm:
                        out.mkdir(parents=True)
                        plain(out, images, 0)
                        shutil.rmtree(out)
                    out.mkdir(parents=True)
                    begun, cpu = time.perf_counter(), sum(os.times()[:4])
                    each = way(out, images)
                    spent, cpu = time.perf_counter() - begun, sum(os.times()[:4]) - cpu
                    shutil.rmtree(out)
                    rate = (
                        f"{1 / each:.0f} ({images / spent:.0f})"
                        if each
                        else f"{images / spent:.0f}"
                    )
                    print(
                        f"{folder!s:<12} {name:<12} {images} images, round {number}: {rate} "
                        f"images/s, "
                        f"{images * IMAGE / spent / 1e9:.2f} GB/s, {1e3 * cpu / images:.2f} ms "
                        f"of CPUs each",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
