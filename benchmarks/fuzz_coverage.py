"""Fuzz the readers of foreign files under coverage, by libFuzzer: inputs that reach new lines are
kept and changed further. The random form, which needs no package, is benchmarks/fuzz.py.

    pip install atheris
    python benchmarks/fuzz_coverage.py [--seconds S] [--only READER ..] [--corpus DIR]

An input is a number, which file of the reader's folder it replaces, and the bytes of that file; the
first ones are the whole files of tests/damaged_files.py. An error of errors.py is what damage
should end in. Anything else ends the process of its reader and is a finding, as is an input that
takes ten seconds or 4 GB: DIR/READER/found-*. Files that a hash protects are left to fuzz.py. What
reached new lines stays in DIR/READER/inputs, from which the next call goes on. Prints a row per
reader; the exit code is 1 if there is a finding.
"""

from __future__ import annotations

import argparse
import logging
import multiprocessing
import os
import re
import shutil
import sys
import tempfile
from pathlib import Path

import atheris

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

OURS = ("data", "importers", "scene.falloff", "sim.mesh_file", "sim.scene_file")
OTHERS = ("tomllib", "trimesh.exchange")
INSTRUMENTED = [*(f"gftorf_warp.{part}" for part in OURS), *OTHERS]
with atheris.instrument_imports(include=INSTRUMENTED):
    from damaged_files import READERS, whole

    from gftorf_warp.errors import GftorfError

LIMITS = ("-timeout=10", "-rss_limit_mb=4096", "-max_len=262144", "-reload=0")
ENDED = re.compile(r"cov: (\d+) .*corp: (\d+)/")
RUNS = re.compile(r"stat::number_of_executed_units: (\d+)")


def fuzz(name: str, corpus: Path, seconds: int) -> None:
    """Fuzz one reader until the time is over or something is found; ends the process."""
    log = os.open(corpus.parent / "log.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(log, sys.stdout.fileno())
    os.dup2(log, sys.stderr.fileno())
    reader, place = READERS[name], Path(tempfile.mkdtemp()) / "files"
    with atheris.instrument_imports(include=INSTRUMENTED):
        shutil.copytree(whole(name), place)
        reader.read(place)  # imports what it needs
    files = [path for path in sorted(place.glob(reader.damaged)) if path.is_file()]
    contents = [path.read_bytes() for path in files]
    for number, content in enumerate(contents):
        (corpus / f"whole-{number}").write_bytes(bytes([number]) + content)

    def attempt(data: bytes) -> None:
        if not data:
            return
        number = data[0] % len(files)
        files[number].write_bytes(data[1:])
        try:
            reader.read(place)
        except GftorfError:
            pass  # what damage should end in
        finally:
            files[number].write_bytes(contents[number])

    words = [sys.argv[0], str(corpus), *LIMITS, f"-max_total_time={seconds}"]
    words += [f"-artifact_prefix={corpus.parent}/found-", "-print_final_stats=1"]
    atheris.Setup(words, attempt)
    atheris.Fuzz()


def row(name: str, place: Path, seconds: int) -> tuple[list[str], bool]:
    """Cells of a reader after its time, and whether it ended otherwise than by its time."""
    corpus = place / name / "inputs"
    corpus.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        tempfile.tempdir = temporary  # of the process, too
        process = multiprocessing.get_context("fork").Process(
            target=fuzz, args=(name, corpus, seconds)
        )
        process.start()
        process.join()
        tempfile.tempdir = None
    log = (place / name / "log.txt").read_text(errors="replace")
    covered, runs = ENDED.findall(log), RUNS.findall(log)
    lines, inputs = covered[-1] if covered else ("-", "-")
    found = process.exitcode != 0
    tried, verdict = runs[-1] if runs else "-", "see log.txt" if found else "none"
    return [name, tried, lines, inputs, verdict], found


def main() -> int:
    """Readers one after the other, each in a process of its own; 1 if anything was found."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--seconds", type=int, default=60, help="for each reader")
    parser.add_argument("--only", nargs="+", help="readers, as in tests/damaged_files.py")
    parser.add_argument("--corpus", type=Path, default=Path("fuzz-corpus"), help="inputs and logs")
    options = parser.parse_args()
    logging.disable()
    names = [name for name, reader in READERS.items() if not reader.protected]
    names = [name for name in names if "run" not in name and "checkpoint" not in name]
    print("| files | inputs tried | edges reached | inputs kept | found |\n|---|---|---|---|---|")
    failed = False
    for name in options.only or names:
        cells, found = row(name, options.corpus.resolve(), options.seconds)
        failed |= found
        print("|", " | ".join(cells), "|", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
