"""SIGKILL at random moments, a few of them: benchmarks/kills.py does it as often as one likes."""

import json
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "kills.py"


def test_killed_commands_end_with_the_bytes_of_undisturbed_ones():
    """No checkpoint is unreadable, no temporary file stays."""
    words = ["--kills", "2", "--commands", "reconstruct"]
    done = subprocess.run(
        [sys.executable, str(SCRIPT), *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    row = json.loads(done.stdout)
    assert row["kills"] == 2
    assert row["completed"] >= 1
