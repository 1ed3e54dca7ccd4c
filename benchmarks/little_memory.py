"""Commands under a limit on address space: each ends with its result, or with exit code 5.

    python benchmarks/little_memory.py [--size WxH] [--frames N] [--commands A;B]

Every command runs ten times in this process, with 0.5 to 128 MB more than it has mapped already, on
the CPU. Prints a row per command: the exit code at each limit. The exit code of the script is 1 if
there was another one than 0 and 5, or if the checkpoint of a run does not load.
"""

from __future__ import annotations

import argparse
import json
import re
import resource
import sys
import tempfile
from pathlib import Path

from tiny_commands import commands, quiet

EXTRA_MB = (0.5, 2, 4, 8, 12, 16, 24, 32, 64, 128)


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


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="160x120")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--commands", help="some of them, separated by semicolons")
    options, failed = parser.parse_args(), False
    with tempfile.TemporaryDirectory() as folder:
        inputs, place = Path(folder) / "inputs", Path(folder) / "outputs"
        inputs.mkdir()
        known = commands(inputs, place, options.size, options.frames)
        names = options.commands.split(";") if options.commands else [*known]
        for name in names:
            command, codes, loads = known[name], [], True
            command.reset()
            assert quiet(command.words) == 0, name  # what it imports and compiles is loaded
            for extra in EXTRA_MB:
                command.reset()
                codes.append(limited(command.words, extra))
                loads &= command.loads()
            failed |= not {*codes} <= {0, 5} or not loads
            row = {"command": name, "extra_mb": EXTRA_MB, "exit_codes": codes, "loads": loads}
            print(json.dumps(row), flush=True)
    sys.exit(failed)
