"""Commands under a limit on address space: each ends with its result, or with exit code 5.

    python benchmarks/little_memory.py [--size WxH] [--frames N]

Every command runs ten times in this process, with 0.5 to 128 MB more than it has mapped already, on
the CPU. Prints a row per command: the exit code at each limit. The exit code of the script is 1 if
there was another one than 0 and 5, or if the checkpoint of a refused run does not load.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import re
import resource
import shutil
import sys
import tempfile
from pathlib import Path

from gftorf_warp.cli import main
from gftorf_warp.recon import checkpoint

EXTRA_MB = (0.5, 2, 4, 8, 12, 16, 24, 32, 64, 128)


def commands(place: Path, size: str, frames: int) -> dict[str, tuple[list[str], Path]]:
    """Arguments, and the folder that a command writes, which it may not find."""
    seq, run = str(place / "seq"), str(place / "run")
    fit = ["--preset", "demo", "--images", "16"]
    device = ["--device", "cpu", "-q"]
    words = {
        "simulate": ["simulate", "demo", "--size", size, "--frames", str(frames), "-q", "--out"],
        "reconstruct": ["reconstruct", seq, *fit, *device, "--out"],
        "render": ["render", run, *device, "--out"],
    }
    known = {
        name: ([*given, str(place / f"{name}d")], place / f"{name}d")
        for name, given in words.items()
    }
    return known | {"compare": (["compare", run, *device], place / "run" / "report.html")}


def mapped() -> int:
    """Bytes of address space that this process has."""
    return 1024 * int(re.findall(r"VmSize:\s+(\d+)", Path("/proc/self/status").read_text())[0])


def limited(words: list[str], extra_mb: float) -> int:
    """Exit code of a command that may map so much more."""
    limit = mapped() + round(1e6 * extra_mb)
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
    try:
        return quiet(words)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY,) * 2)


def quiet(words: list[str]) -> int:
    """Exit code of a command whose output is dropped."""
    sink = io.StringIO()
    with contextlib.redirect_stdout(sink), contextlib.redirect_stderr(sink):
        return main(words)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="160x120")
    parser.add_argument("--frames", type=int, default=8)
    options, failed = parser.parse_args(), False
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        known = commands(place, options.size, options.frames)
        for name, made in (("simulate", "seq"), ("reconstruct", "run"), ("render", "out")):
            assert quiet([*known[name][0][:-1], str(place / made)]) == 0  # kernels are loaded
        assert quiet(known["compare"][0]) == 0
        for name, (words, written) in known.items():
            codes = []
            for extra in EXTRA_MB:
                shutil.rmtree(written, ignore_errors=True)
                codes.append(limited(words, extra))
                if name == "reconstruct" and (written / "ckpt").is_dir():
                    checkpoint.last(written)  # raises if it does not load
            failed |= not {*codes} <= {0, 5}
            print(json.dumps({"command": name, "extra_mb": EXTRA_MB, "exit_codes": codes}))
    sys.exit(failed)
