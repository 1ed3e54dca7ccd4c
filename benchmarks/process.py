"""Where the wall clock of one command goes, from the shell's prompt to the next.

    python benchmarks/process.py [--runs N] [--json FILE] COMMAND ...
    python benchmarks/process.py reconstruct SEQ --out RUN --preset fast --fresh
    python benchmarks/process.py --runs 3 compare RUN

Runs ``gftorf COMMAND ...`` N times (2; the first may compile kernels), each in a process of its
own, and prints the phases of the last run in the order in which they began. A phase excludes those
inside it. Times are those of the host's main thread: the device is not synchronised for them, so
work of the device counts where the host waits for it. Then the imports of the last run: the
slowest ones with the line of this package that caused them, and the modules of every package at the
end. -X importtime is too slow for this: it writes a line per module.
"""

from __future__ import annotations

import argparse
import builtins
import collections
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

PHASES = {  # functions that begin a phase, by module; those of one name are one phase
    "cli": {"start": "start of torch and Warp"},
    "data.read": {"read": "read", "read_truth": "read truth"},
    "data.flow": {"compute_flow": "optical flow"},
    "data.check": {"check": "check"},
    "recon.observations": {"data_hash": "hash"},
    "recon.train": {
        "observe": "observe",
        "begin": "initialise",
        "reconstruct": "rest of reconstruct",
    },
    "recon.loop": {"TrainingLoop.run": "rest of the training loop", "TrainingLoop.report": "log"},
    "recon.stepper": {
        "Stepper.step": "steps",
        "Stepper._captured": "graph capture",
        "Stepper.collect": "wait for the device",
    },
    "recon.diagnostics": {"Diagnostics.render": "diagnostics", "Diagnostics.write": "diagnostics"},
    "recon.checkpoint": {"save": "checkpoint", "last": "read checkpoint"},
    "recon.run": {"Run.open": "open run"},
    "evaluate.views": {"gather": "render and decode", "render_to_folder": "render to folder"},
    "evaluate.gallery": {
        "colour_views": "colour and novel views",
        "novel_views": "colour and novel views",
    },
    "evaluate.compare": {
        "comparison_of": "errors",
        "summary": "errors",
        "write_report": "report",
        "compare": "compare",
    },
    "sim.simulate": {"simulate": "simulate"},
}
SHOWN = 24  # imports, and packages
FIRST = {"steps": "first step"}  # name of the first call of a phase, where that differs


class Clock:
    """Seconds and calls of phases that may contain each other."""

    def __init__(self, begun: float):
        self.seconds: dict[str, float] = {}
        self.calls: dict[str, int] = {}
        self.stack = ["interpreter and the rest"]
        self.since = begun

    def switch(self) -> None:
        """Add the time since the last call to the innermost phase."""
        now = time.time()
        name = self.stack[-1]
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self.since
        self.since = now

    def timed(self, name: str, function: Callable) -> Callable:
        """The function, as a phase."""

        def wrapped(*arguments, **named):
            self.switch()
            label = FIRST[name] if name in FIRST and FIRST[name] not in self.calls else name
            self.calls[label] = self.calls.get(label, 0) + 1
            self.seconds.setdefault(label, 0.0)
            self.stack.append(label)
            try:
                return function(*arguments, **named)
            finally:
                self.switch()
                self.stack.pop()

        return wrapped


class Patcher:
    """Turns functions into phases when their modules have been imported;
    an import is a phase itself.
    """

    def __init__(self, clock: Clock):
        self.clock, self.waiting, self.depth = (
            clock,
            {f"gftorf_warp.{name}": PHASES[name] for name in PHASES},
            0,
        )
        self.original = builtins.__import__
        self.import_timed = clock.timed("imports", self.original)
        self.imports: list[dict] = []  # outermost ones that loaded modules

    def __call__(self, *arguments, **named):
        """In place of ``__import__``."""
        if threading.current_thread() is not threading.main_thread():
            return self.original(*arguments, **named)
        outermost = self.depth == 0
        begun, modules = time.time(), len(sys.modules)
        self.depth += 1
        try:
            found = (self.import_timed if outermost else self.original)(*arguments, **named)
        finally:
            self.depth -= 1
        if outermost and len(sys.modules) > modules:
            self.imports.append(
                {
                    "name": str(arguments[0] or arguments[3]),
                    "where": own_line(),
                    "modules": len(sys.modules) - modules,
                    "seconds": time.time() - begun,
                }
            )
        if outermost and self.waiting:
            for name in [name for name in self.waiting if name in sys.modules]:
                self.patch(name, self.waiting.pop(name))
        return found

    def patch(self, module: str, phases: dict[str, str]) -> None:
        """Replace functions wherever modules of the package name them."""
        for path, label in phases.items():
            owner, _, name = path.rpartition(".")
            holder = getattr(sys.modules[module], owner, None) if owner else sys.modules[module]
            if holder is None or name not in vars(holder):
                print(f"no {module}.{path}", file=sys.stderr)
                continue
            what = vars(holder)[name]
            if isinstance(what, classmethod):
                setattr(holder, name, classmethod(self.clock.timed(label, what.__func__)))
                continue
            timed = self.clock.timed(label, what)
            homes = (
                [holder]
                if owner
                else [m for key, m in sys.modules.items() if key.startswith("gftorf_warp")]
            )
            for home in homes:
                if vars(home).get(name) is what:
                    setattr(home, name, timed)


def own_line() -> str:
    """File and line of this package that is being executed, for example ``cli.py:133``."""
    frame = sys._getframe(2)
    while frame is not None and "/gftorf_warp/" not in frame.f_code.co_filename:
        frame = frame.f_back
    if frame is None:
        return "-"
    return f"{frame.f_code.co_filename.rpartition('/gftorf_warp/')[2]}:{frame.f_lineno}"


def by_package() -> dict[str, int]:
    """Number of loaded modules by package, most first; torch by subpackage."""
    names = (name.split(".") for name in [*sys.modules])
    packages = (".".join(parts[: 2 if parts[0] == "torch" else 1]) for parts in names)
    return dict(collections.Counter(packages).most_common())


def child(report: Path, begun: float, command: list[str]) -> None:
    """Run a command with phases, and end as ``gftorf`` does."""
    clock = Clock(begun)
    builtins.__import__ = patcher = Patcher(clock)
    from gftorf_warp import cli

    sys.argv = ["gftorf", *command]
    code = cli.main()
    clock.switch()
    stored = {"seconds": clock.seconds, "calls": clock.calls, "ended": time.time()}
    stored |= {"imports": patcher.imports, "packages": by_package()}
    report.write_text(json.dumps(stored))
    sys.exit(code)


def run(command: list[str]) -> dict:
    """Phases and wall clock of one command [s]."""
    with tempfile.TemporaryDirectory() as folder:
        report, begun = Path(folder) / "phases.json", time.time()
        words = [sys.executable, __file__, "--child", str(report), "--begun", repr(begun), *command]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL, env=os.environ)
        ended, found = time.time(), json.loads(report.read_text())
    found["seconds"]["exit"] = ended - found.pop("ended")
    return found | {"wall": ended - begun}


def print_imports(run: dict) -> None:
    """The slowest imports, and the packages with the most modules."""
    print(f"\n{'import':40}{'modules':>8}{'seconds':>9}  caused by")
    for one in sorted(run["imports"], key=lambda one: -one["seconds"])[:SHOWN]:
        print(f"{one['name']:40}{one['modules']:8}{one['seconds']:9.3f}  {one['where']}")
    packages = run["packages"]
    most = ", ".join(f"{name} {count}" for name, count in [*packages.items()][:SHOWN])
    print(f"{sum(packages.values())} modules at the end: {most}\n")


def main() -> None:
    """Measure, print, and optionally store as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--begun", type=float, help=argparse.SUPPRESS)
    parser.add_argument("command", nargs=argparse.REMAINDER)
    options = parser.parse_args()
    if options.child:
        child(options.child, options.begun, options.command)
    runs = [run(options.command) for _ in range(options.runs)]
    last = runs[-1]
    for name, seconds in last["seconds"].items():
        print(f"{name:32}{last['calls'].get(name, 1):8}{seconds:9.3f} s")
    print_imports(last)
    walls = [one["wall"] for one in runs]
    print(
        f"{'wall clock':40}{last['wall']:9.3f} s; all runs "
        f"{', '.join(f'{wall:.2f}' for wall in walls)}"
    )
    if len(runs) > 2:
        print(f"{'median but the first':40}{statistics.median(walls[1:]):9.3f} s")
    if options.json:
        options.json.write_text(
            json.dumps({"command": options.command, "runs": runs}, indent=1) + "\n"
        )


if __name__ == "__main__":
    main()
